"""Scripted play: repeatable, within bounds, all over the workspace, and it moves what can be moved."""

from __future__ import annotations

import gymnasium
import numpy as np
import pytest

import envs  # noqa: F401
from data_collection.policies.base import Policy
from data_collection.policies.play import PlayPolicy
from data_collection.policies.play_motion import POINTING_DOWN, Follower, hand_orientation, rotation_between
from data_collection.policies.play_scene import Scene
from data_collection.policies.play_skills import FIXTURE_SKILLS
from envs.errors import UsageError
from envs.planar_push import PlanarPushEnv
from envs.tabletop.table import BLOCKS

STEPS, EPISODES = 240, 14
SCALE = np.array([0.02, 0.02, 0.02, 0.05, 0.05, 0.05])


@pytest.fixture(scope="module")
def env():
    env = gymnasium.make("t3vip/TabletopC-v0", images=False)
    yield env
    env.close()


def play(env: gymnasium.Env, seed: int, steps: int = STEPS, policy: Policy | None = None):
    """Actions (T, 7), TCP positions (T, 3), fixture openings (T, 4) and block positions (T, 3, 3) of one episode."""
    policy = policy or PlayPolicy()
    observation, _ = env.reset(seed=seed)
    policy.reset(env, np.random.default_rng(seed))
    scene = Scene(env)
    record = []
    for _ in range(steps):
        action = policy.act(observation)
        observation, *_ = env.step(action)
        fixtures = [scene.opening(name) for name in FIXTURE_SKILLS]
        blocks = [scene.block(name).position for name in BLOCKS]
        record.append((action, scene.tcp, fixtures, blocks))
    return tuple(np.array(column) for column in zip(*record, strict=True))


@pytest.fixture(scope="module")
def episodes(env):
    return [np.stack(column) for column in zip(*(play(env, seed) for seed in range(EPISODES)), strict=True)]


def test_the_same_seeds_play_the_same(env):
    policy = PlayPolicy()
    first = play(env, 3, 80, policy)
    play(env, 4, 10, policy)  # nothing of another episode is left behind
    for one, other in zip(first, play(env, 3, 80, policy), strict=True):
        np.testing.assert_array_equal(one, other)
    assert not np.array_equal(first[0], play(env, 4, 80, policy)[0])


def test_it_refuses_other_environments():
    other = PlanarPushEnv(images=False)
    with pytest.raises(UsageError, match="policy 'play' cannot act in PlanarPushEnv; use --env tabletop"):
        PlayPolicy().reset(other, np.random.default_rng(0))
    other.close()


def test_actions_are_bounded_and_use_their_range(env, episodes):
    actions = episodes[0]
    assert actions.dtype == np.float32
    assert all(env.action_space.contains(action) for action in actions.reshape(-1, 7))
    assert set(np.unique(actions[..., 6])) == {-1.0, 1.0}
    assert (np.abs(actions[..., :3]).reshape(-1, 3).max(axis=0) > 0.95).all()
    assert (actions[..., :3].reshape(-1, 3).std(axis=0) > 0.25).all()


def test_motion_is_smooth(episodes):
    """From one action to the next changes less than between two random ones: a third of it."""
    actions = episodes[0][..., :3]
    step = np.abs(np.diff(actions, axis=1)).mean()
    shuffled = np.abs(actions[:-1] - actions[1:]).mean()
    assert step < shuffled / 3


def test_the_hand_visits_the_whole_workspace(env, episodes):
    tcp = episodes[1].reshape(-1, 3)
    scene = Scene(env)
    edges = [np.linspace(low, high, 5) for low, high in zip(scene.low, scene.high, strict=True)]
    visits, _ = np.histogramdd(tcp, bins=edges)
    centres = np.stack(np.meshgrid(*((edge[1:] + edge[:-1]) / 2 for edge in edges), indexing="ij"), axis=-1)
    free = np.apply_along_axis(scene.free, -1, centres)
    assert free.sum() > 25
    assert (visits[free] > 0).mean() > 0.9
    assert visits[free].max() / visits.sum() < 0.15  # it does not sit in one corner


def test_the_hand_moves_in_all_directions_also_along_the_view(env, episodes):
    motion = np.diff(episodes[1], axis=1).reshape(-1, 3)
    speed = np.linalg.norm(motion, axis=-1)
    moving = motion[speed > 0.004] / speed[speed > 0.004, None]
    spread = np.linalg.eigvalsh(moving.T @ moving / len(moving))
    assert spread[0] > 0.15  # a third each if all directions were as frequent
    along_view = moving @ Scene(env).optical_axis
    assert (along_view > 0.8).mean() > 0.05 and (along_view < -0.8).mean() > 0.05
    assert np.quantile(speed, 0.95) > 0.018


def test_every_fixture_and_block_moves(episodes):
    """At least in one of seven episodes each; over many episodes it is a quarter or more."""
    fixtures, blocks = episodes[2], episodes[3]
    moved = np.concatenate(
        [
            np.ptp(fixtures, axis=1) > 0.3,
            np.linalg.norm(blocks - blocks[:, :1], axis=-1).max(axis=1) > 0.03,
        ],
        axis=1,
    )
    shares = dict(zip([*FIXTURE_SKILLS, *BLOCKS], moved.mean(axis=0), strict=True))
    assert min(shares.values()) >= 1 / 7, shares
    assert moved.sum(axis=1).mean() >= 1.5
    assert (blocks[..., 2].max(axis=1) > 0.52).any()  # something was lifted


def test_the_follower_stops_at_its_goal():
    """Alone, without noise: it gets there, never faster than asked, and hardly overshoots."""
    follower = Follower(SCALE, np.random.default_rng(0))
    position, goal = np.zeros(6), np.array([0.3, -0.1, 0.05, 0.2, 0.0, -0.4])
    path = []
    for _ in range(80):
        action = follower.act(goal - position, speed=0.6, noise=0.0)
        assert np.abs(action).max() <= 0.6 + 1e-9
        position = position + SCALE * action
        path.append(position)
    np.testing.assert_allclose(position, goal, atol=1e-3)
    assert np.max(np.array(path)[:, 0]) < 0.3 + 0.01


@pytest.mark.parametrize("yaw, tilt", [(0.7, (0.0, 0.0)), (0.0, (0.3, 0.0)), (0.0, (0.0, -0.2))])
def test_orientations_turn_about_the_axes_they_name(yaw, tilt):
    np.testing.assert_allclose(rotation_between(POINTING_DOWN, hand_orientation(yaw, tilt)), [*tilt, yaw], atol=1e-9)
