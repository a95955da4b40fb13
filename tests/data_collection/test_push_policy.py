"""The push policy: 12-frame pushes that move the object, ways round it that do not, an object that stays in view."""

from __future__ import annotations

import numpy as np
import pytest

from data_collection.environments import resolve_env, usual_policy
from data_collection.policies import make_policy
from data_collection.policies.push import PUSH_STEPS
from envs.errors import UsageError
from envs.planar_push import PlanarPushEnv
from envs.tabletop import TabletopEnv

STEPS = 120


def episode(env: PlanarPushEnv, seed: int, name: str = "push") -> tuple[np.ndarray, np.ndarray]:
    """Actions (T, 3) and poses of the object (T + 1, 3)."""
    observation, _ = env.reset(seed=seed)
    policy = make_policy(name)
    policy.reset(env, np.random.default_rng(seed))
    actions, poses = [], [env.object_pose]
    for _ in range(STEPS):
        actions.append(policy.act(observation))
        observation = env.step(actions[-1])[0]
        poses.append(env.object_pose)
    return np.array(actions), np.array(poses)


def pushes(actions: np.ndarray) -> list[tuple[int, int, int]]:
    """Start of the way, start of the push, and end of each push; a heading belongs to a way and the push after it."""
    turns = np.flatnonzero(np.diff(actions[:, 2])) + 1
    starts = [0, *turns]
    return [(first, last - PUSH_STEPS, last) for first, last in zip(starts, turns, strict=False)]


def test_pushes_move_the_object_and_ways_round_it_do_not():
    env = PlanarPushEnv("all", images=False)
    moved, brushed, off_line = [], [], []
    for seed in range(4):
        actions, poses = episode(env, seed)
        assert np.abs(actions).max() < 1
        assert np.abs(poses[:, :2]).max() < 0.13  # in view
        for first, start, end in pushes(actions):
            moved.append(np.linalg.norm(poses[end, :2] - poses[start, :2]))
            brushed.append(np.linalg.norm(poses[start, :2] - poses[first, :2]))
            heading = actions[start, 2] * np.pi
            going = actions[start:end, :2]
            off_line.append(np.abs(going @ [-np.sin(heading), np.cos(heading)]).max())
    env.close()
    assert len(moved) >= 12
    assert np.mean(np.array(moved) > 0.02) > 0.9
    assert np.median(moved) > 0.03
    assert max(brushed) < 0.01
    assert max(off_line) < 1e-3  # a push is straight, along its heading


def test_pokes_hit_and_miss_whatever_their_heading():
    env = PlanarPushEnv("all", images=False)
    along, moved = [], []
    for seed in range(6):
        actions, poses = episode(env, seed, "poke")
        assert np.abs(actions).max() <= 1 and np.abs(poses[:, :2]).max() < 0.2
        headings = np.pi * actions[:, 2]
        directions = np.stack([np.cos(headings), np.sin(headings)], axis=1)
        along.append((actions[:, :2] * directions).sum(1) > 0.99 * np.linalg.norm(actions[:, :2], axis=1))
        moved.append(np.linalg.norm(np.diff(poses[:, :2], axis=0), axis=1) > 1e-3)
    env.close()
    along, moved = np.concatenate(along), np.concatenate(moved)
    assert 0.2 < moved[along].mean() < 0.8  # moving along the heading need not move the object
    assert moved[~along].mean() > 0.1  # nor need it be the heading's direction that does


def test_the_same_seed_gives_the_same_episode():
    env = PlanarPushEnv(images=False)
    first, again = episode(env, 5), episode(env, 5)
    env.close()
    np.testing.assert_array_equal(first[0], again[0])
    np.testing.assert_array_equal(first[1], again[1])


def test_an_object_at_the_edge_is_brought_back():
    env = PlanarPushEnv(images=False)
    env.reset(seed=0, options={"pose": [0.15, -0.12, 0.0], "tip": [0.0, 0.0]})
    policy = make_policy("push")
    policy.reset(env, np.random.default_rng(0))
    for _ in range(STEPS):
        env.step(policy.act({}))
    assert np.linalg.norm(env.object_pose[:2]) < 0.13
    env.close()


@pytest.mark.parametrize("name", ["push", "poke"])
def test_it_refuses_other_environments(name):
    env = TabletopEnv(images=False)
    with pytest.raises(UsageError, match=f"policy '{name}' cannot act in TabletopEnv; use --env planar-push"):
        make_policy(name).reset(env, np.random.default_rng(0))
    env.close()


def test_environments_have_their_usual_scenes_and_policies():
    assert resolve_env("planar-push", None) == ("t3vip/PlanarPush-v0", {"split": "train"})
    assert resolve_env("planar-push", "test") == ("t3vip/PlanarPush-v0", {"split": "test"})
    assert resolve_env("tabletop", None) == ("t3vip/TabletopC-v0", {})
    assert usual_policy("planar-push") == usual_policy("envs:t3vip/PlanarPush-v0") == "push"
    assert usual_policy("tabletop") == usual_policy("t3vip/TabletopD-v0") == "play"
    assert usual_policy("my/Env-v0") == "noise"
    for name, scene in (("planar-push", "D"), ("tabletop", "train"), ("my/Env-v0", "C")):
        with pytest.raises(UsageError, match=scene):
            resolve_env(name, scene)
