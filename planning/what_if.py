"""What would happen, by the simulator itself: where end-effector and designated point go. For the oracle only."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Protocol

import gymnasium as gym
import numpy as np
from numpy.typing import NDArray

from envs.errors import UsageError
from envs.planar_push import PlanarPushEnv
from envs.planar_push import simulate as push_simulate
from envs.planar_push.scene import TIP_HEIGHT
from envs.tabletop import simulate as table_simulate
from envs.tabletop.env import FIXTURES, TabletopEnv
from planning.marks import Mark

Array = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Paths:
    """Where things go, after each action: (N, T, 3) metres, world frame."""

    effector: Array
    point: Array


class WhatIf(Protocol):
    """A simulator that tries sequences of actions and leaves the environment alone."""

    def state(self) -> Array:
        """The environment's state now."""

    def paths(self, state: Array, actions: NDArray, mark: Mark | None) -> Paths:
        """What N sequences of actions (N, T, A) lead to from a state of the present episode.

        Args:
            state: from `state`; the environment must still be in it.
            actions: within the action space.
            mark: the point that is asked for; None for the end-effector.
        """

    def close(self) -> None:
        """End the simulator's threads."""


class TabletopWhatIf:
    """Of the tabletop; points are on a fixture, all of which slide."""

    def __init__(self, env: TabletopEnv) -> None:
        self._env, self._simulator = env, table_simulate.BatchSimulator(env)
        self.state, self.close = env.get_state, self._simulator.close

    def paths(self, state: Array, actions: NDArray, mark: Mark | None) -> Paths:
        found = self._simulator.rollout(state, actions)
        if mark is None:
            return Paths(found.tcp, found.tcp)
        if mark.body not in FIXTURES:
            raise UsageError(f"no simulation of points on '{mark.body}'; choose one on {', '.join(FIXTURES)}")
        data, joint = self._env.mj_data, self._env.mj_model.joint(mark.body)
        slid = found.fixtures[..., FIXTURES.index(mark.body)] - data.qpos[joint.qposadr[0]]  # (N, T)
        return Paths(found.tcp, mark.position(self._env) + slid[..., None] * data.xaxis[joint.id])


class PlanarPushWhatIf:
    """Of the planar pusher; points are on the object."""

    def __init__(self, env: PlanarPushEnv) -> None:
        self._env, self._simulator = env, push_simulate.BatchSimulator(env)
        self.state, self.close = env.get_state, self._simulator.close

    def paths(self, state: Array, actions: NDArray, mark: Mark | None) -> Paths:
        found = self._simulator.rollout(state, actions)
        tip = np.concatenate([found.tip, np.full((*found.tip.shape[:2], 1), TIP_HEIGHT)], axis=-1)
        if mark is None:
            return Paths(tip, tip)
        x, y, yaw = np.moveaxis(found.object_pose, -1, 0)  # (N, T)
        cos, sin, (along, across, _) = np.cos(yaw), np.sin(yaw), mark.local
        height = np.full_like(x, mark.position(self._env)[2])  # it stays on the table
        return Paths(tip, np.stack([x + cos * along - sin * across, y + sin * along + cos * across, height], axis=-1))


def what_if(env: gym.Env) -> WhatIf:
    """The simulator of an environment.

    Raises:
        UsageError: there is none.
    """
    inner: Any = env.unwrapped
    if isinstance(inner, TabletopEnv):
        return TabletopWhatIf(inner)
    if isinstance(inner, PlanarPushEnv):
        return PlanarPushWhatIf(inner)
    raise UsageError(f"no simulator for {type(inner).__name__}; leave the oracle out")
