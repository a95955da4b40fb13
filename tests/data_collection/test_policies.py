"""Policies: exact seeds, actions within bounds, noise of the right colour."""

import colorednoise
import numpy as np
import pytest
from standin import StandIn

from data_collection.policies import make_policy
from data_collection.policies.coloured_noise import NoisePolicy, coloured_noise
from envs.errors import UsageError
from envs.planar_push import PlanarPushEnv


@pytest.mark.parametrize("beta", [0.0, 0.7, 2.0, 3.5])
@pytest.mark.parametrize("length", [2, 9, 240])
def test_noise_is_that_of_the_reference_package(beta, length):
    ours = coloured_noise(beta, (3, length), np.random.default_rng(5))
    theirs = colorednoise.powerlaw_psd_gaussian(beta, (3, length), random_state=np.random.default_rng(5))
    np.testing.assert_allclose(ours, theirs, rtol=1e-10, atol=1e-12)


@pytest.mark.parametrize("beta", [0.0, 1.0, 2.0])
def test_power_falls_with_the_exponent(beta):
    noise = coloured_noise(beta, (200, 512), np.random.default_rng(0))
    power = (np.abs(np.fft.rfft(noise)) ** 2).mean(axis=0)[1:-1]
    slope = np.polyfit(np.log(np.fft.rfftfreq(512)[1:-1]), np.log(power), 1)[0]
    assert slope == pytest.approx(-beta, abs=0.1)
    assert noise.var() == pytest.approx(1.0, abs=0.25)


def _actions(name, seed, steps=40):
    env = StandIn()
    obs, _ = env.reset(seed=0)
    policy = make_policy(name)
    policy.reset(env, np.random.default_rng(seed))
    return np.stack([policy.act(obs) for _ in range(steps)])


@pytest.mark.parametrize("name", ["noise", "random"])
def test_actions_follow_from_the_seed_and_fit_the_space(name):
    first = _actions(name, 1)
    np.testing.assert_array_equal(first, _actions(name, 1))
    assert not np.array_equal(first, _actions(name, 2))
    assert first.shape == (40, 3) and np.abs(first).max() <= 1
    assert first.std(axis=0).min() > 0.05


def test_noise_is_smoother_than_random_and_commands_signs_as_signs():
    smooth, rough = _actions("noise", 0, 400), _actions("random", 0, 400)

    def jump(actions):
        return np.abs(np.diff(actions[:, :2], axis=0)).mean() / actions[:, :2].std()

    assert jump(smooth) < jump(rough) / 2
    assert set(np.unique(smooth[:, 2])) == {-1.0, 1.0}


def test_noise_spreads_over_absolute_targets_that_are_no_signs():
    env = PlanarPushEnv(images=False)
    env.reset(seed=0)
    policy = make_policy("noise")
    policy.reset(env, np.random.default_rng(0))
    heading = np.stack([policy.act({}) for _ in range(400)])[:, 2]
    env.close()
    assert len(np.unique(heading)) > 200 and (np.abs(heading) < 0.9).mean() > 0.6
    assert np.histogram(heading, 8, (-1, 1))[0].min() > 0


def test_noise_goes_on_after_its_block():
    env = StandIn()
    policy = NoisePolicy(block=8)
    policy.reset(env, np.random.default_rng(0))
    blocks = np.stack([policy.act({}) for _ in range(24)]).reshape(3, 8, 3)
    assert not np.array_equal(blocks[0], blocks[1])


def test_unknown_policy_lists_the_known():
    with pytest.raises(UsageError, match="'teleport'; choose one of play, push, poke, predictive, noise, random"):
        make_policy("teleport")
