"""Setups of planar pushing: an object, a point on top of it, and where that point shall be."""

from __future__ import annotations

from typing import Any

import gymnasium as gym
import numpy as np

from envs.planar_push.wardrobe import HEIGHT
from planning.point_setups import PointSetup, point_setup, seen_on
from planning.setups import SEED_OFFSET

PUSH_ENTROPY = 0x9054_0B1EC7  # sets the seeds of these setups apart from all others
NEAREST, FARTHEST = 0.05, 0.12  # metres from the point to its goal
ON_TOP = 0.004  # metres below the highest that still count as the object's top
ROOM = 0.13  # metres from the middle of the table, along x and y, to which an object may go: the tip must get round it
SCENES = 100


def make_push_setup(env: gym.Env, index: int, seed: int = 0) -> PointSetup:
    """The setup of that index; the same for every model, every run and every number of setups.

    Object, pose, hidden variables and the tip's place are those of a random episode. The point is a random one that the
    camera sees on the object's top; the way to its goal has a random direction along the table.

    Args:
        env: a planar pushing environment that renders; its state is changed.
        index: which setup.
        seed: of the evaluation.

    Raises:
        RuntimeError: none was found, which means that the environment is broken.
    """
    push: Any = env.unwrapped
    rng = np.random.default_rng(np.random.SeedSequence((PUSH_ENTROPY, seed, index)))
    for _ in range(SCENES):
        env_seed = SEED_OFFSET + int(rng.integers(2**32))
        observation, _ = env.reset(seed=env_seed)
        point = seen_on(env, "object", observation["depth"], rng, lambda points: points[..., 2] > HEIGHT - ON_TOP)
        bearing, distance = rng.uniform(-np.pi, np.pi), rng.uniform(NEAREST, FARTHEST)
        way = distance * np.array([np.cos(bearing), np.sin(bearing), 0.0])
        middle = push.object_pose[:2]
        if point is None or np.abs(middle + way[:2]).max() > ROOM:
            continue
        part = "behind" if (middle - push.tip_position) @ way[:2] > 0 else "round"
        return point_setup(env, index, env_seed, push.get_state(), "object", point, way, part)
    raise RuntimeError(f"no goal in {SCENES} scenes for setup {index} of seed {seed}")
