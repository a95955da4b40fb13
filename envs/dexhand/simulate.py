"""What-if in the real simulator: many action sequences at once, from given states, on all cores, without pictures."""

from __future__ import annotations

import os
from dataclasses import dataclass

import mujoco
import numpy as np
from mujoco import rollout
from numpy.typing import ArrayLike, NDArray

from envs.dexhand import control
from envs.dexhand.env import INTEGRATION_STATE, OWN_STATE, DexHandEnv
from envs.dexhand.scene import SUBSTEPS
from envs.errors import UsageError

PHYSICS_STATE = mujoco.mjtState.mjSTATE_FULLPHYSICS
CHUNK_STEPS = 1000  # control steps simulated at a time: bounds the memory


@dataclass(frozen=True, eq=False)
class Paths:
    """Where everything goes, after each action."""

    cube_pose: NDArray[np.float64]
    """(N, T, 7) position, metres, and unit quaternion wxyz."""
    joint_angles: NDArray[np.float64]
    """(N, T, 24) radians."""
    end: NDArray[np.float64]
    """(N, P) physics at the end, for `go_on`."""


class BatchSimulator:
    """Simulates batches of action sequences exactly as the environment would; leaves it alone.

    Args:
        env: whose model to simulate.
        threads: simulations run in parallel; one per available core when None.
    """

    def __init__(self, env: DexHandEnv, threads: int | None = None) -> None:
        self._env, self._model = env, env.mj_model
        threads = threads or len(os.sched_getaffinity(0))
        self._data = [mujoco.MjData(self._model) for _ in range(threads)]
        self._pool = rollout.Rollout(nthread=threads)
        start = mujoco.mj_stateSize(self._model, mujoco.mjtState.mjSTATE_TIME)
        self._cube, self._hand = (
            slice(start + part.start, start + part.stop) for part in (env.cube_qpos, env.hand_qpos)
        )

    def close(self) -> None:
        """End the threads."""
        self._pool.close()

    def rollout(self, states: ArrayLike, actions: ArrayLike) -> Paths:
        """Where cube and hand go.

        Args:
            states: (S,) one state for all, or (N, S) one for each, from `DexHandEnv.get_state`.
            actions: (N, T, 20) in [-1, 1]; clipped.

        Raises:
            UsageError: the shapes do not fit, or an action is not finite.
        """
        return self.go_on(*self._unpack(states, len(np.atleast_1d(actions))), actions)

    def physics(self, state: ArrayLike) -> NDArray[np.float64]:
        """What moves in a state (S,) from `DexHandEnv.get_state`: (P,), as `go_on` takes it."""
        return self._unpack(state, 1)[0][0]

    def go_on(self, physics: NDArray[np.float64], warmstart: NDArray[np.float64] | None, actions: ArrayLike) -> Paths:
        """`rollout` from the end of others.

        Args:
            physics: (N, P), `Paths.end`.
            warmstart: (N, V) of the solver. Without it, results differ from the environment's by what the solver
                tolerates.
            actions: (N, T, 20) in [-1, 1]; clipped.

        Raises:
            UsageError: actions have another shape, or are not finite.
        """
        actions = np.asarray(actions, np.float64)
        if actions.ndim != 3 or actions.shape[2] != control.ACTUATORS or not np.isfinite(actions).all():
            raise UsageError(f"actions have shape {actions.shape}; give finite numbers of shape (N, T, 20)")
        targets = control.joint_targets(self._model, np.clip(actions, -1, 1))
        size = max(1, CHUNK_STEPS // max(1, actions.shape[1]))
        paths = [np.empty((0, actions.shape[1], physics.shape[1]))]
        for first in range(0, len(actions), size):
            some = slice(first, first + size)
            visited, _ = self._pool.rollout(
                self._model,
                self._data,
                initial_state=physics[some],
                control=np.repeat(targets[some], SUBSTEPS, axis=1),
                initial_warmstart=None if warmstart is None else warmstart[some],
            )
            paths.append(visited[:, SUBSTEPS - 1 :: SUBSTEPS].copy())
        after = np.concatenate(paths)
        return Paths(after[..., self._cube], after[..., self._hand], after[:, -1])

    def _unpack(self, states: ArrayLike, count: int) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Full physics states and warm starts of the solver, one row for each sequence."""
        model = self._model
        states = np.atleast_2d(np.asarray(states, np.float64))
        size = mujoco.mj_stateSize(model, INTEGRATION_STATE)
        if states.ndim != 2 or states.shape[1] != size + OWN_STATE or len(states) not in (1, count):
            raise UsageError(
                f"states have shape {states.shape}; give (1 or {count}, {size + OWN_STATE}) of get_state()"
            )
        parts = []
        for signature in (PHYSICS_STATE, mujoco.mjtState.mjSTATE_WARMSTART):
            part = np.empty((len(states), mujoco.mj_stateSize(model, signature)))
            for state, row in zip(states, part, strict=True):
                mujoco.mj_extractState(model, state[:size].copy(), INTEGRATION_STATE, row, signature)
            parts.append(np.repeat(part, count // len(part), axis=0))
        return parts[0], parts[1]
