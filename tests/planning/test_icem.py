"""iCEM does what its paper says, step by step, and solves toys."""

import time

import numpy as np
import pytest

from envs.errors import UsageError
from planning.icem import ICEM, ICEMConfig

LOW, HIGH = -np.ones(3), np.ones(3)


def make(seed=0, deadline=None, **options):
    return ICEM(ICEMConfig(**options), LOW, HIGH, np.random.default_rng(seed), deadline)


class Recorder:
    """A cost function that remembers what it was asked; the optimum is at `target` in every step."""

    def __init__(self, target=0.3):
        self.target, self.batches = target, []

    def __call__(self, actions):
        self.batches.append(actions.copy())
        return ((actions - self.target) ** 2).sum(axis=(1, 2))


def test_population_schedule_and_one_call_per_iteration():
    planner, cost = make(), Recorder()
    assert ICEMConfig().populations() == [40, 32, 25]
    plan = planner.plan(cost)
    assert [len(batch) for batch in cost.batches] == [40, 32, 25]
    assert plan.rollouts == 97 and plan.complete
    planner.plan(cost)
    assert [len(batch) for batch in cost.batches[3:]] == [43, 32, 25]  # 0.3 * 10 shifted elites
    assert ICEMConfig(population=100, iterations=5, elites=20).populations() == [100, 80, 64, 51, 40]


def test_samples_are_clipped_to_the_bounds():
    planner, cost = make(init_std=3.0), Recorder()
    planner.plan(cost)
    batch = cost.batches[0]
    assert batch.min() == -1 and batch.max() == 1 and (np.abs(batch) == 1).mean() > 0.3


def test_first_samples_spread_as_asked():
    planner, cost = make(horizon=5, population=4000, iterations=1, noise_beta=0.0, init_std=0.1), Recorder()
    planner.plan(cost)
    kept_mean = np.sqrt(5 / 4)  # five steps of white noise, and the mean of each series on top
    np.testing.assert_allclose(cost.batches[0].std(axis=0), 0.1 * kept_mean, rtol=0.06)


def test_a_small_population_has_at_most_half_of_it_for_elites():
    assert ICEMConfig(population=8).populations() == [8, 8, 8]
    planner, cost = make(population=8), Recorder()
    planner.plan(cost)
    assert len(planner._elites) == 4


def test_the_search_starts_in_the_middle_of_bounds_that_are_not_symmetric():
    low, high = np.array([0.0, -4.0]), np.array([2.0, 8.0])
    config = ICEMConfig(horizon=5, population=4000, iterations=1, noise_beta=0.0, init_std=0.1)
    planner, cost = ICEM(config, low, high, np.random.default_rng(0)), Recorder()
    planner.plan(cost)
    np.testing.assert_allclose(cost.batches[0].mean(axis=(0, 1)), [1.0, 2.0], atol=0.05)
    np.testing.assert_allclose(cost.batches[0].std(axis=(0, 1)) / np.sqrt(5 / 4), [0.1, 0.6], rtol=0.06)


def test_at_the_default_horizon_samples_spread_twice_as_far():
    """As documented: the noise keeps its mean, and in a series of two there is as much of that as of the rest."""
    planner, cost = make(population=4000, iterations=1, init_std=0.1), Recorder()
    planner.plan(cost)
    assert ICEMConfig().horizon == 2
    np.testing.assert_allclose(cost.batches[0].std(axis=0), 0.2, rtol=0.06)
    assert abs(np.corrcoef(cost.batches[0][:, :, 0].T)[0, 1]) < 0.06


def test_the_mean_joins_in_the_last_iteration_only():
    planner, cost = make(), Recorder()
    means = []
    fit = planner._fit
    planner._fit = lambda elites: (fit(elites), means.append(planner.mean.copy()))[0]
    planner.plan(cost)
    np.testing.assert_array_equal(cost.batches[2][0], means[1])
    assert not any((batch == 0).all(axis=(1, 2)).any() for batch in cost.batches[:1])
    assert not (cost.batches[1] == means[0]).all(axis=(1, 2)).any()


def test_momentum_and_fit():
    planner, cost = make(iterations=2, keep_fraction=0.0), Recorder()
    pulled = []
    fit = planner._fit

    def watched(elites):
        before = planner.mean.copy(), planner.std.copy()
        fit(elites)
        pulled.append((elites.copy(), before, (planner.mean.copy(), planner.std.copy())))

    planner._fit = watched
    planner.plan(cost)
    for elites, (mean, std), (new_mean, new_std) in pulled:
        assert len(elites) == 10
        np.testing.assert_allclose(new_mean, 0.9 * elites.mean(0) + 0.1 * mean)
        np.testing.assert_allclose(new_std, 0.9 * elites.std(0) + 0.1 * std)


def test_kept_elites_compete_with_the_cost_they_had():
    """The second iteration's costs are all worse, so the kept three lead the elites and the plan, unsimulated."""
    planner = make(iterations=2)
    batches, elites = [], []
    fit = planner._fit
    planner._fit = lambda pool: (elites.append(pool.copy()), fit(pool))[1]

    def cost(actions):
        batches.append(actions.copy())
        return np.abs(actions).sum(axis=(1, 2)) + 1000.0 * (len(batches) - 1)

    plan = planner.plan(cost)
    best = batches[0][np.argsort(np.abs(batches[0]).sum(axis=(1, 2)))]
    np.testing.assert_array_equal(elites[1][:3], best[:3])
    np.testing.assert_array_equal(plan.actions, best[0])
    assert plan.cost < 1000
    assert sum((batches[1] == best[i]).all(axis=(1, 2)).any() for i in range(3)) == 0


def test_the_next_plan_starts_from_shifted_elites_and_mean_with_fresh_deviation():
    planner, cost = make(horizon=6), Recorder()
    planner.plan(cost)
    elites = planner._elites.copy()
    np.testing.assert_array_equal(planner.mean[-1], planner.mean[-2])
    assert (planner.std == 0.5).all()
    planner.plan(cost)
    shifted = cost.batches[3][-3:]
    np.testing.assert_array_equal(shifted[:, :-1], elites[:3, 1:])
    planner.reset()
    assert (planner.mean == 0).all() and planner._elites is None


def test_what_is_kept_and_what_is_shifted_are_two_shares():
    for share, sizes in (({"keep_fraction": 0.0}, [43, 32, 25]), ({"shift_fraction": 0.5}, [45, 32, 25])):
        planner, cost = make(**share), Recorder()
        for _ in range(2):
            planner.plan(cost)
        assert [len(batch) for batch in cost.batches[3:]] == sizes
    planner, calls = make(iterations=2, keep_fraction=0.0), []
    plan = planner.plan(lambda actions: np.full(len(actions), float(len(calls.append(0) or calls))))
    assert plan.cost == 2  # of the last iteration, though the one before it was better


def test_where_few_costs_are_finite_there_are_fewer_elites():
    planner, cost = make(), Recorder()
    planner.plan(lambda actions: np.where(np.arange(len(actions)) < 3, cost(actions), np.nan))
    assert len(planner._elites) == 3


def test_the_executed_action_is_of_the_best_sequence_of_the_last_pool():
    planner, cost = make(keep_fraction=0.0), Recorder()
    plan = planner.plan(cost)
    costs = Recorder()(cost.batches[-1])
    np.testing.assert_array_equal(plan.actions, cost.batches[-1][costs.argmin()])
    assert plan.cost == costs.min()


@pytest.mark.parametrize("poison", [np.nan, np.inf, -np.inf])
def test_non_finite_costs_never_become_elite(poison):
    planner, cost = make(), Recorder()
    elites = []
    fit = planner._fit
    planner._fit = lambda pool: (elites.append(pool.copy()), fit(pool))[1]

    def poisoned(actions):
        return np.where(actions[:, 0, 0] > 0.0, poison, cost(actions))  # the good half, too

    plan = planner.plan(poisoned)
    assert np.isfinite(plan.cost) and plan.actions[0, 0] <= 0
    assert all((pool[:, 0, 0] <= 0).all() for pool in elites)


def test_nothing_but_nan_leaves_a_plan_within_bounds():
    plan = make().plan(lambda actions: np.full(len(actions), np.nan))
    assert plan.cost == np.inf and np.isfinite(plan.actions).all()


def test_deadline_gives_the_best_so_far():
    cost = Recorder()

    def slow(actions):
        time.sleep(0.05)
        return cost(actions)

    plan = make(deadline=0.06).plan(slow)
    assert len(cost.batches) == 1 and not plan.complete and plan.rollouts == 40
    assert plan.cost == Recorder()(cost.batches[0]).min()


def test_solves_a_quadratic():
    planner, cost = make(horizon=5), Recorder(target=np.array([0.5, -0.7, 0.1]))
    for _ in range(10):
        plan = planner.plan(cost)
    np.testing.assert_allclose(plan.actions[0], [0.5, -0.7, 0.1], atol=0.15)


@pytest.mark.parametrize("delay", [0, 3])
def test_brings_a_delayed_point_to_its_goal(delay):
    """Receding horizon on a point whose action takes effect `delay` steps later."""
    goal, position = np.array([0.3, -0.2, 0.25]), np.zeros(3)
    planner = make(horizon=6, seed=1)
    queue = [np.zeros(3)] * delay

    def cost(actions):
        waiting = np.broadcast_to(np.array(queue).reshape(1, delay, 3), (len(actions), delay, 3))
        moves = np.concatenate([waiting, actions], axis=1)[:, : actions.shape[1]]
        path = position + np.cumsum(0.06 * moves, axis=1)
        return np.linalg.norm(path - goal, axis=-1) @ 0.95 ** np.arange(actions.shape[1])

    for _ in range(33):
        queue.append(planner.plan(cost).actions[0])
        position = position + 0.06 * queue.pop(0)
    assert np.linalg.norm(position - goal) < 0.03


def test_same_seed_same_plan():
    a, b = (make(seed=4).plan(Recorder()).actions for _ in range(2))
    np.testing.assert_array_equal(a, b)


@pytest.mark.parametrize(
    "options",
    [
        {"horizon": 0},
        {"population": 1},
        {"decay": 0.5},
        {"momentum": 1.0},
        {"init_std": np.inf},
        *(
            {name: np.nan}
            for name in ("decay", "momentum", "init_std", "noise_beta", "keep_fraction", "shift_fraction")
        ),
    ],
)
def test_bad_settings_are_named(options):
    with pytest.raises(UsageError, match=next(iter(options))):
        ICEMConfig(**options)


@pytest.mark.parametrize(
    ("low", "high"),
    [
        (-1, 1),
        (-np.ones((1, 3)), np.ones((1, 3))),
        (-np.ones(2), HIGH),
        (HIGH, LOW),
        (LOW, [1, 1, -1]),
        (LOW, HIGH * np.inf),
    ],
)
def test_bounds_that_leave_nothing_to_search_are_refused(low, high):
    with pytest.raises(UsageError, match=r"low is .*, high is .*; give"):
        ICEM(ICEMConfig(), low, high, np.random.default_rng(0))


def test_a_cost_of_the_wrong_shape_is_a_bug():
    with pytest.raises(ValueError, match="shape"):
        make().plan(lambda actions: np.zeros((len(actions), 1)))
