"""BOHB and HEBO themselves, where their packages are installed: what they suggest, learn and remember."""

from dataclasses import replace

import numpy as np
import pytest
from ray.tune.search import Searcher, SearchGenerator

from worldmodel.options import PRESETS
from worldmodel.tuning.searchers import NEEDS, Numbered, make_searcher, ray_space
from worldmodel.tuning.space import POWER, axes_of, point_of

BUDGETS = (1, 3, 9)
TINY = replace(PRESETS["tiny"], model="cdna")
AXES = axes_of(TINY)
BEST = {"learning_rate": 3e-4, "rgb": 0.1}


def beginner(name):
    for package in NEEDS[name]:
        pytest.importorskip(package, exc_type=ImportError)

    def begin():
        searcher = make_searcher(name, AXES, point_of(TINY, AXES), BUDGETS, seed=0)
        assert searcher.set_search_properties("score", "max", ray_space(AXES))
        return searcher

    return begin


@pytest.fixture(params=["bohb", "hebo"])
def begin(request):
    """Begins a search of two axes and the power."""
    return beginner(request.param)


def seed_global(seed):
    """The generator that searchers draw from."""
    np.random.seed(seed)  # noqa: NPY002


def off(point):
    """How far a point is from the best one."""
    return sum(abs(np.log(point[name] / best)) for name, best in BEST.items()) + 2 * (point[POWER] != 2)


def result(point, step):
    return {"step": step, "score": 40 - off(point) - 5 / step, "diverged": False}


def run(searcher, numbers):
    """Trials one after another, each to the end; gives their points."""
    points = []
    for number in numbers:
        trial, point = f"trial{number}", searcher.suggest(f"trial{number}")
        for step in BUDGETS[:-1]:
            searcher.on_trial_result(trial, result(point, step))
        searcher.on_trial_complete(trial, result(point, BUDGETS[-1]))
        points.append(point)
    return points


def save(searcher, folder):
    """As Ray does."""
    SearchGenerator(searcher).save_to_dir(str(folder), "now")


def restore(searcher, folder):
    SearchGenerator(searcher).restore_from_dir(str(folder))
    return searcher


def test_suggestions_lie_in_the_ranges_and_come_nearer_to_the_best(begin):
    searcher = begin()
    seed_global(0)
    first, *points = run(searcher, range(25))
    assert [point["number"] for point in points] == list(range(1, 25))
    assert first == {**point_of(TINY, AXES), "number": 0}
    for axis in AXES:
        assert all(axis.low <= point[axis.name] <= axis.high for point in points)
    assert {point[POWER] for point in points} == {1, 2}
    distances = [off(point) for point in points]
    assert np.mean(distances[12:]) < 0.75 * np.mean(distances[:12])


def test_a_searcher_that_was_saved_goes_on_as_if_it_had_not_ended(begin, tmp_path):
    searcher = begin()
    run(searcher, range(9))
    save(searcher, tmp_path)
    seed_global(1)
    expected = run(searcher, range(9, 12))
    assert [point["number"] for point in expected] == [9, 10, 11]
    other = restore(begin(), tmp_path)
    seed_global(1)
    assert run(other, range(9, 12)) == expected


def test_a_trial_that_failed_may_be_tried_again(begin, tmp_path):
    searcher = begin()
    searcher.suggest("trial0")
    point = searcher.suggest("trial1")
    searcher.on_trial_result("trial1", result(point, 1))
    searcher.on_trial_complete("trial1", error=True)
    save(searcher, tmp_path)
    other = restore(begin(), tmp_path)
    other.on_trial_result("trial1", result(point, 1))
    other.on_trial_complete("trial1", result(point, 9))
    assert [point["number"] for point in run(other, range(2, 4))] == [2, 3]


class Forgetful(Searcher):
    """Has no place for a trial that has ended, as BOHB and HEBO."""

    def __init__(self):
        super().__init__(metric="score", mode="max")
        self.known = set()

    def suggest(self, trial_id):
        self.known.add(trial_id)
        return BEST

    def on_trial_complete(self, trial_id, result=None, error=False):
        self.known.remove(trial_id)


def test_of_a_trial_that_failed_a_searcher_hears_no_more_also_when_restored():
    searcher, other = (Numbered(Forgetful(), BEST) for _ in range(2))
    assert [searcher.suggest(trial)["number"] for trial in "abc"] == [0, 1, 2]
    searcher.on_trial_complete("b", error=True)
    searcher.on_trial_complete("b", {"score": 1.0})
    assert searcher.searcher.known == {"c"}
    other.set_state(searcher.get_state())
    other.on_trial_complete("b", {"score": 1.0})
    assert other.suggest("d")["number"] == 3


def test_bohb_counts_a_score_at_a_budget_once_and_a_trial_that_diverged_as_the_worst():
    searcher = beginner("bohb")()
    for number in range(4):
        searcher.suggest(f"trial{number}")
    for step, score in ((1, 30.0), (2, 31.0), (1, 30.0)):  # the last one told again, by a trial that goes on
        searcher.on_trial_result("trial1", {"step": step, "score": score, "diverged": False})
    searcher.on_trial_complete("trial1", {"step": 3, "score": 32.0, "diverged": False})
    searcher.on_trial_complete("trial2", {"step": 0, "score": 0.0, "diverged": True})
    searcher.on_trial_complete("trial3", {"step": 9, "score": 0.0, "diverged": True})
    assert searcher.searcher.bohber.losses == {1: [-30, 0], 3: [-32], 9: [0]}
