"""What-if in the real simulator: many action sequences at once, from given states, on all cores, without pictures."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from envs.actions import clip_sequences
from envs.batch import BatchPhysics
from envs.dexhand import control
from envs.dexhand.env import DexHandEnv
from envs.dexhand.scene import SUBSTEPS


@dataclass(frozen=True, eq=False)
class Paths:
    """Where everything goes, after each action."""

    cube_pose: NDArray[np.float64]
    """(N, T, 7) position, metres, and unit quaternion wxyz."""
    joint_angles: NDArray[np.float64]
    """(N, T, 24) radians."""
    end: NDArray[np.float64]
    """(N, P) physics at the end, for `go_on`."""


class BatchSimulator(BatchPhysics[DexHandEnv]):
    """Simulates batches of action sequences exactly as the environment would; leaves it alone.

    Args:
        env: whose model to simulate.
        threads: simulations run in parallel; one per available core when None.
    """

    def __init__(self, env: DexHandEnv, threads: int | None = None) -> None:
        super().__init__(env, SUBSTEPS, threads)
        self._cube, self._hand = self._positions(env.cube_qpos), self._positions(env.hand_qpos)

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
        targets = control.joint_targets(self._model, clip_sequences(actions, control.ACTUATORS))
        after = self._simulate(physics, warmstart, targets)
        return Paths(after[..., self._cube], after[..., self._hand], after[:, -1])
