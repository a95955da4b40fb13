"""What-if in the real simulator: many action sequences at once, from given states, on all cores, without pictures."""

from __future__ import annotations

import os
from dataclasses import dataclass

import mujoco
import numpy as np
from mujoco import rollout
from numpy.typing import ArrayLike, NDArray

from envs.errors import UsageError
from envs.planar_push import control
from envs.planar_push.env import INTEGRATION_STATE, OWN_STATE, PlanarPushEnv, object_poses
from envs.planar_push.scene import SUBSTEPS

PHYSICS_STATE = mujoco.mjtState.mjSTATE_FULLPHYSICS
CHUNK_STEPS = 2000  # control steps simulated at a time: bounds the memory


@dataclass(frozen=True, eq=False)
class Paths:
    """Where everything goes, after each action."""

    tip: NDArray[np.float64]
    """(N, T, 2) measured position of the tip, metres."""
    object_pose: NDArray[np.float64]
    """(N, T, 3) x, y (m) and yaw (rad) of the object."""


class BatchSimulator:
    """Simulates batches of action sequences as the environment would without action noise; leaves it alone.

    The object and the hidden variables are those that the environment has at the time of the call: this simulator knows
    what a model has to guess.

    Args:
        env: whose model to simulate.
        threads: simulations run in parallel; one per available core when None.
    """

    def __init__(self, env: PlanarPushEnv, threads: int | None = None) -> None:
        self._env, self._model = env, env.mj_model
        threads = threads or len(os.sched_getaffinity(0))
        self._data = [mujoco.MjData(self._model) for _ in range(threads)]
        self._pool = rollout.Rollout(nthread=threads)
        start = mujoco.mj_stateSize(self._model, mujoco.mjtState.mjSTATE_TIME)
        self._object, self._tip = (
            slice(start + part.start, start + part.stop) for part in (env.object_qpos, env.tip_qpos)
        )
        start += self._model.nq + self._model.nv
        self._target = slice(start, start + self._model.na)

    def close(self) -> None:
        """End the threads."""
        self._pool.close()

    def rollout(self, states: ArrayLike, actions: ArrayLike) -> Paths:
        """Where tip and object go.

        Args:
            states: (S,) one state for all, or (N, S) one for each, from `PlanarPushEnv.get_state`.
            actions: (N, T, 3) in [-1, 1]; clipped.

        Raises:
            UsageError: the shapes do not fit, an action is not finite, or a state is of another object.
        """
        actions = np.asarray(actions, np.float64)
        if actions.ndim != 3 or actions.shape[2] != 3 or not np.isfinite(actions).all():
            raise UsageError(f"actions have shape {actions.shape}; give finite numbers of shape (N, T, 3)")
        actions = np.clip(actions, -1, 1)
        physics, warmstart = self._unpack(states, len(actions))
        controls = self._controls(physics[:, self._target], actions)
        size = max(1, CHUNK_STEPS // max(1, actions.shape[1]))
        paths = []
        for first in range(0, len(actions), size):
            some = slice(first, first + size)
            visited, _ = self._pool.rollout(
                self._model,
                self._data,
                initial_state=physics[some],
                control=controls[some],
                initial_warmstart=warmstart[some],
            )
            paths.append(visited[:, SUBSTEPS - 1 :: SUBSTEPS].copy())
        states_after = np.concatenate(paths) if paths else np.empty((0, actions.shape[1], physics.shape[1]))
        return Paths(states_after[..., self._tip], object_poses(states_after[..., self._object]))

    def _controls(self, target: NDArray[np.float64], actions: NDArray[np.float64]) -> NDArray[np.float64]:
        """(N, T * SUBSTEPS, 4) from the first targets (N, 2) and the actions (N, T, 3)."""
        controls = np.empty((*actions.shape[:2], self._model.nu))
        for step in range(actions.shape[1]):
            start, target = target, control.advance(target, actions[:, step])
            controls[:, step] = control.motor_commands(start, target)
        return np.repeat(controls, SUBSTEPS, axis=1)

    def _unpack(self, states: ArrayLike, count: int) -> tuple[NDArray, NDArray]:
        model, env = self._model, self._env
        states = np.atleast_2d(np.asarray(states, np.float64))
        size = mujoco.mj_stateSize(model, INTEGRATION_STATE)
        if states.ndim != 2 or states.shape[1] != size + OWN_STATE or len(states) not in (1, count):
            raise UsageError(
                f"states have shape {states.shape}; give (1 or {count}, {size + OWN_STATE}) of get_state()"
            )
        identity = slice(size, size + env.hidden.vector().size + 1)
        if not (states[:, identity] == env.get_state()[identity]).all():
            raise UsageError(
                "a state has another object or other hidden variables than the environment; set_state first"
            )
        parts = []
        for signature in (PHYSICS_STATE, mujoco.mjtState.mjSTATE_WARMSTART):
            part = np.empty((len(states), mujoco.mj_stateSize(model, signature)))
            for state, row in zip(states, part, strict=True):
                mujoco.mj_extractState(model, state[:size].copy(), INTEGRATION_STATE, row, signature)
            parts.append(np.repeat(part, count // len(part), axis=0))
        return parts[0], parts[1]
