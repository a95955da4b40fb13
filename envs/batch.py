"""What the batch simulators have in common: many copies of an environment's physics at once, without pictures."""

from __future__ import annotations

import os
from typing import Generic, TypeVar

import mujoco
import numpy as np
from mujoco import rollout
from numpy.typing import ArrayLike, NDArray

from envs.base import INTEGRATION_STATE, RGBDEnv
from envs.errors import UsageError

Env = TypeVar("Env", bound=RGBDEnv)
Array = NDArray[np.float64]

PHYSICS_STATE = mujoco.mjtState.mjSTATE_FULLPHYSICS
CHUNK_STEPS = 1000  # control steps simulated at a time: bounds the memory


class BatchPhysics(Generic[Env]):
    """Simulates an environment's model from many states in parallel; leaves the environment alone.

    What moves is a row (P,): MuJoCo's full physics, that is time, positions, velocities and activations.

    Args:
        env: whose model to simulate.
        substeps: physics steps in a control step.
        threads: simulations run in parallel; one per available core when None.
    """

    def __init__(self, env: Env, substeps: int, threads: int | None = None) -> None:
        self._env, self._model, self._substeps = env, env.mj_model, substeps
        threads = threads or len(os.sched_getaffinity(0))
        self._data = [mujoco.MjData(self._model) for _ in range(threads)]
        self._pool = rollout.Rollout(nthread=threads)

    def close(self) -> None:
        """End the threads."""
        self._pool.close()

    def _positions(self, part: slice = slice(None)) -> slice:
        """Where a row of physics has these parts of `qpos`."""
        start = mujoco.mj_stateSize(self._model, mujoco.mjtState.mjSTATE_TIME)
        first, end, _ = part.indices(self._model.nq)
        return slice(start + first, start + end)

    def _velocities(self) -> slice:
        """Where a row of physics has `qvel`."""
        start = self._positions().stop
        return slice(start, start + self._model.nv)

    def _activations(self) -> slice:
        """Where a row of physics has `act`."""
        start = self._velocities().stop
        return slice(start, start + self._model.na)

    def _unpack(self, states: ArrayLike, count: int) -> tuple[Array, Array]:
        """What moves (count, P) and the solver's warm starts (count, V) in states of the environment.

        Args:
            states: (S,) one for all, or (count, S) one for each, from `get_state`.
            count: how many rows to make.

        Raises:
            UsageError: they have another shape.
        """
        model, size = self._model, self._env.state_size
        states = np.atleast_2d(np.asarray(states, np.float64))
        if states.ndim != 2 or states.shape[1] != size or len(states) not in (1, count):
            raise UsageError(f"states have shape {states.shape}; give (1 or {count}, {size}) of get_state()")
        parts = []
        for signature in (PHYSICS_STATE, mujoco.mjtState.mjSTATE_WARMSTART):
            part = np.empty((len(states), mujoco.mj_stateSize(model, signature)))
            for state, row in zip(states, part, strict=True):
                physics = state[: size - self._env.OWN_STATE].copy()
                mujoco.mj_extractState(model, physics, INTEGRATION_STATE, row, signature)
            parts.append(np.repeat(part, count // len(part), axis=0))
        return parts[0], parts[1]

    def _substep(self, physics: Array, warmstart: Array | None, controls: Array) -> Array:
        """Every physics step (N, T * substeps, P) under controls (N, T, nu) that hold for a control step each."""
        visited, _ = self._pool.rollout(
            self._model,
            self._data,
            initial_state=physics,
            control=np.repeat(controls, self._substeps, axis=1),
            initial_warmstart=warmstart,
        )
        return visited

    def _simulate(self, physics: Array, warmstart: Array | None, controls: Array) -> Array:
        """What has moved after each control step, (N, T, P).

        Args:
            physics: (N, P) to begin with.
            warmstart: (N, V) of the solver. Without it, results differ from the environment's by what the solver
                tolerates.
            controls: (N, T, nu).
        """
        size = max(1, CHUNK_STEPS // max(1, controls.shape[1]))
        after = np.empty((*controls.shape[:2], physics.shape[1]))
        for first in range(0, len(controls), size):
            some = slice(first, first + size)
            warm = None if warmstart is None else warmstart[some]
            visited = self._substep(physics[some], warm, controls[some])
            after[some] = visited[:, self._substeps - 1 :: self._substeps]
        return after
