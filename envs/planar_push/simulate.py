"""What-if in the real simulator: many action sequences at once, from given states, on all cores, without pictures."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from envs.actions import clip_sequences
from envs.batch import BatchPhysics
from envs.errors import UsageError
from envs.planar_push import control
from envs.planar_push.env import PlanarPushEnv, object_poses
from envs.planar_push.hidden import NUMBERS
from envs.planar_push.scene import SUBSTEPS


@dataclass(frozen=True, eq=False)
class Paths:
    """Where everything goes, after each action."""

    tip: NDArray[np.float64]
    """(N, T, 2) measured position of the tip, metres."""
    object_pose: NDArray[np.float64]
    """(N, T, 3) x, y (m) and yaw (rad) of the object."""


class BatchSimulator(BatchPhysics[PlanarPushEnv]):
    """Simulates batches of action sequences as the environment would without action noise; leaves it alone.

    The object and the hidden variables are those that the environment has at the time of the call: this simulator knows
    what a model has to guess.

    Args:
        env: whose model to simulate.
        threads: simulations run in parallel; one per available core when None.
    """

    def __init__(self, env: PlanarPushEnv, threads: int | None = None) -> None:
        super().__init__(env, SUBSTEPS, threads)
        self._object, self._tip = self._positions(env.object_qpos), self._positions(env.tip_qpos)
        self._target = self._activations()

    def rollout(self, states: ArrayLike, actions: ArrayLike) -> Paths:
        """Where tip and object go.

        Args:
            states: (S,) one state for all, or (N, S) one for each, from `PlanarPushEnv.get_state`.
            actions: (N, T, 3) in [-1, 1]; clipped.

        Raises:
            UsageError: the shapes do not fit, an action is not finite, or a state is of another object.
        """
        actions = clip_sequences(actions, 3)
        physics, warmstart = self._unpack(states, len(actions))
        after = self._simulate(physics, warmstart, self._controls(physics[:, self._target], actions))
        return Paths(after[..., self._tip], object_poses(after[..., self._object]))

    def _controls(self, target: NDArray[np.float64], actions: NDArray[np.float64]) -> NDArray[np.float64]:
        """(N, T, 4) from the first targets (N, 2) and the actions (N, T, 3)."""
        controls = np.empty((*actions.shape[:2], self._model.nu))
        for step in range(actions.shape[1]):
            start, target = target, control.advance(target, actions[:, step])
            controls[:, step] = control.motor_commands(start, target)
        return controls

    def _unpack(self, states: ArrayLike, count: int) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        parts, env = super()._unpack(states, count), self._env
        first = env.state_size - env.OWN_STATE
        identity = slice(first, first + NUMBERS + 1)
        if not (np.asarray(states)[..., identity] == env.get_state()[identity]).all():
            raise UsageError(
                "a state has another object or other hidden variables than the environment; set_state first"
            )
        return parts
