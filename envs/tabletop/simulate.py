"""What-if in the real simulator: many action sequences at once, from given states, on all cores, without pictures."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from envs.actions import clip_sequences
from envs.batch import BatchPhysics
from envs.tabletop import control
from envs.tabletop.control import Pose
from envs.tabletop.env import FIXTURES, TabletopEnv
from envs.tabletop.scene import SUBSTEPS, TIMESTEP


@dataclass(frozen=True, eq=False)
class Paths:
    """Where things go, after each action."""

    tcp: NDArray[np.float64]
    """(N, T, 3) measured position of the tool centre point, metres, world frame."""
    fixtures: NDArray[np.float64]
    """(N, T, 4) positions of the joints of `FIXTURES`, metres."""


class BatchSimulator(BatchPhysics[TabletopEnv]):
    """Simulates batches of action sequences as the environment would, to rounding; leaves the environment alone.

    Args:
        env: whose model to simulate.
        threads: simulations run in parallel; one per available core when None.
    """

    def __init__(self, env: TabletopEnv, threads: int | None = None) -> None:
        super().__init__(env, SUBSTEPS, threads)
        self._qpos, self._qvel = self._positions(), self._velocities()
        self._fixtures = [self._qpos.start + int(self._model.joint(name).qposadr[0]) for name in FIXTURES]

    def rollout(self, states: ArrayLike, actions: ArrayLike) -> Paths:
        """Where the tool centre point and the fixtures go.

        Args:
            states: (S,) one state for all, or (N, S) one for each, from `TabletopEnv.get_state`.
            actions: (N, T, 7) in [-1, 1]; clipped.

        Raises:
            UsageError: the shapes do not fit, or an action is not finite.
        """
        actions = clip_sequences(actions, 7)
        physics, warmstart = self._unpack(states, len(actions))
        tcps, fixtures = np.empty((*actions.shape[:2], 3)), np.empty((*actions.shape[:2], len(FIXTURES)))
        tcp = self._tcp(physics)
        for step in range(actions.shape[1]):
            controls = self._aim(physics, tcp, actions[:, step])
            substeps = self._substep(physics, warmstart, controls[:, None])
            physics = substeps[:, -1].copy()
            warmstart = (substeps[:, -1, self._qvel] - substeps[:, -2, self._qvel]) / TIMESTEP
            tcp = self._tcp(physics)
            tcps[:, step], fixtures[:, step] = tcp.position, physics[:, self._fixtures]
        return Paths(tcps, fixtures)

    def rollout_tcp(self, states: ArrayLike, actions: ArrayLike) -> NDArray[np.float64]:
        """Of `rollout`, the tool centre point: (N, T, 3) metres."""
        return self.rollout(states, actions).tcp

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
