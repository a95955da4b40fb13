"""What-if in the real simulator: many action sequences at once, from given states, on all cores, without pictures."""

from __future__ import annotations

import os

import mujoco
import numpy as np
from mujoco import rollout
from numpy.typing import ArrayLike, NDArray

from envs.errors import UsageError
from envs.tabletop import control
from envs.tabletop.control import Pose
from envs.tabletop.env import INTEGRATION_STATE, TabletopEnv
from envs.tabletop.scene import SUBSTEPS, TIMESTEP

PHYSICS_STATE = mujoco.mjtState.mjSTATE_FULLPHYSICS


class BatchSimulator:
    """Simulates batches of action sequences as the environment would, to rounding; leaves the environment alone.

    Args:
        env: whose model to simulate.
        threads: simulations run in parallel; one per available core when None.
    """

    def __init__(self, env: TabletopEnv, threads: int | None = None) -> None:
        self._env, self._model = env, env.mj_model
        threads = threads or len(os.sched_getaffinity(0))
        self._data = [mujoco.MjData(self._model) for _ in range(threads)]
        self._pool = rollout.Rollout(nthread=threads)
        nq, nv = self._model.nq, self._model.nv
        start = mujoco.mj_stateSize(self._model, mujoco.mjtState.mjSTATE_TIME)
        self._qpos, self._qvel = slice(start, start + nq), slice(start + nq, start + nq + nv)

    def close(self) -> None:
        """End the threads."""
        self._pool.close()

    def rollout_tcp(self, states: ArrayLike, actions: ArrayLike) -> NDArray[np.float64]:
        """Where the tool centre point goes.

        Args:
            states: (S,) one state for all, or (N, S) one for each, from `TabletopEnv.get_state`.
            actions: (N, T, 7) in [-1, 1]; clipped.

        Returns:
            (N, T, 3) measured position after each action, metres, world frame.

        Raises:
            UsageError: the shapes do not fit, or an action is not finite.
        """
        actions = np.asarray(actions, np.float64)
        if actions.ndim != 3 or actions.shape[2] != 7 or not np.isfinite(actions).all():
            raise UsageError(f"actions have shape {actions.shape}; give finite numbers of shape (N, T, 7)")
        actions = np.clip(actions, -1, 1)
        physics, warmstart = self._unpack(states, len(actions))
        path = np.empty((*actions.shape[:2], 3))
        for step in range(actions.shape[1]):
            tcp = self._tcp(physics)
            controls = self._aim(physics, tcp, actions[:, step])
            substeps, _ = self._pool.rollout(
                self._model,
                self._data,
                initial_state=physics,
                control=np.repeat(controls[:, None], SUBSTEPS, axis=1),
                initial_warmstart=warmstart,
            )
            physics = substeps[:, -1].copy()
            warmstart = (substeps[:, -1, self._qvel] - substeps[:, -2, self._qvel]) / TIMESTEP
            path[:, step] = self._tcp(physics).position
        return path

    def _unpack(self, states: ArrayLike, count: int) -> tuple[NDArray, NDArray]:
        model = self._model
        states = np.atleast_2d(np.asarray(states, np.float64))
        size = mujoco.mj_stateSize(model, INTEGRATION_STATE)
        if states.ndim != 2 or states.shape[1] != size + 2 or len(states) not in (1, count):
            raise UsageError(f"states have shape {states.shape}; give (1 or {count}, {size + 2}) from get_state()")
        parts = []
        for signature in (PHYSICS_STATE, mujoco.mjtState.mjSTATE_WARMSTART):
            part = np.empty((len(states), mujoco.mj_stateSize(model, signature)))
            for state, row in zip(states, part, strict=True):
                mujoco.mj_extractState(model, state[:size].copy(), INTEGRATION_STATE, row, signature)
            parts.append(np.repeat(part, count // len(part), axis=0))
        return parts[0], parts[1]

    def _tcp(self, physics: NDArray) -> Pose:
        return self._env.kinematics.tcp(physics[:, self._qpos][:, self._env.kinematics.qpos_index])

    def _aim(self, physics: NDArray, tcp: Pose, actions: NDArray) -> NDArray:
        """Give the target its velocity, as `TabletopEnv.step` does; returns the controls (N, nu)."""
        env = self._env
        qpos, qvel = physics[:, self._qpos], physics[:, self._qvel]  # views
        start = Pose(qpos[:, env.target_qpos][:, :3], qpos[:, env.target_qpos][:, 3:])
        qvel[:, env.target_dofs] = control.velocity(start, control.advance(start, tcp, actions))
        controls = np.zeros((len(actions), self._model.nu))
        controls[:, env.finger_ctrl] = control.finger_targets(actions[:, 6])
        return controls


def rollout_tcp(env: TabletopEnv, states: ArrayLike, actions: ArrayLike) -> NDArray[np.float64]:
    """`BatchSimulator.rollout_tcp` for a single call."""
    simulator = BatchSimulator(env)
    try:
        return simulator.rollout_tcp(states, actions)
    finally:
        simulator.close()
