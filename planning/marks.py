"""Where a designated point truly is. For the judge and for the oracle; no other controller is given one."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import gymnasium as gym
import numpy as np
from numpy.typing import NDArray

from envs import rotations

Array = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Mark:
    """A point that is fixed to a body of the simulator.

    Attributes:
        body: its name.
        local: (3,) metres, in the frame of the body.
    """

    body: str
    local: Array

    @classmethod
    def at(cls, env: gym.Env, body: str, point: Array) -> Mark:
        """The mark at a point (3,) of the world, as things lie now."""
        position, quaternion = _pose(env, body)
        return cls(body, rotations.rotate(rotations.conjugate(quaternion), np.asarray(point, np.float64) - position))

    def position(self, env: gym.Env) -> Array:
        """Where it is now: (3,) metres, world frame."""
        position, quaternion = _pose(env, self.body)
        return position + rotations.rotate(quaternion, self.local)


def point_position(env: gym.Env, mark: Mark | None) -> Array:
    """Where a mark is, or the end-effector where there is none: (3,) metres, world frame."""
    inner: Any = env.unwrapped
    return np.array(inner.tcp_position) if mark is None else mark.position(env)


def _pose(env: gym.Env, body: str) -> tuple[Array, Array]:
    """Position (3,) and quaternion wxyz (4,) of a body."""
    inner: Any = env.unwrapped
    pose = inner.body_poses()[inner.body_names.index(body)]
    return pose[:3], pose[3:]
