"""Controllers without a world model: what servoing takes, and what it does not."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from envs.tabletop.control import ACTION_SCALE
from planning.controllers.base import Goal, HoldingController, Observation, PlanningController, tcp_position
from planning.costs import discounted_distance
from planning.icem import CostFunction

METRES_PER_ACTION = ACTION_SCALE[0]  # of a full translation over one control step


class RandomController(HoldingController):
    """Uniform translations, held as long as a planned one: the lower bound."""

    name = "random"

    def __init__(self, hold: int, rng: np.random.Generator) -> None:
        super().__init__(hold)
        self.rng = rng

    def decide(self, observation: Observation) -> NDArray:
        return self.rng.uniform(-1, 1, 3)


class ProportionalController(HoldingController):
    """Straight to the goal by proprioception, knowing the units of the actions; decides at every control step.

    Args:
        gain: share of the remaining way that is commanded per step.
    """

    name = "proportional"

    def __init__(self, gain: float = 0.5) -> None:
        super().__init__(hold=1)
        self.gain = gain

    def decide(self, observation: Observation) -> NDArray:
        move = self.gain * (self.goal.point_world - tcp_position(observation)) / METRES_PER_ACTION
        return move / max(1.0, np.abs(move).max())


class LinearController(PlanningController):
    """Plans with a linear model `TCP motion = B @ action`, fitted by least squares while the episode runs.

    It knows nothing to begin with: its first decisions move along x, y and z in turn, and from then on every decision
    refits B to the whole episode. What it costs to learn the arm anew is thus inside the budget of steps.
    """

    name = "linear"
    ridge = 1e-6  # keeps the fit defined; in squared action units, against probes of size 1

    def reset(self, observation: Observation, goal: Goal) -> None:
        super().reset(observation, goal)
        self._moves: list[NDArray] = []
        self._positions: list[NDArray] = []

    def decide(self, observation: Observation) -> NDArray:
        self._positions.append(tcp_position(observation))
        probes = np.eye(3) * np.sign(self.goal.point_world - self._positions[0])[:, None]
        tried = len(self._moves)
        move = probes[tried] if tried < len(probes) else super().decide(observation)
        self._moves.append(move)
        return move

    def imagine(self, observation: Observation) -> CostFunction:
        moves = np.array(self._moves)
        motions = np.diff(self._positions, axis=0)
        transposed = np.linalg.solve(moves.T @ moves + self.ridge * np.eye(3), moves.T @ motions)  # B^T

        def cost(sequences: NDArray) -> NDArray:
            positions = self._positions[-1] + np.cumsum(sequences @ transposed, axis=1)  # (N, h, 3)
            return discounted_distance(np.linalg.norm(positions - self.goal.point_world, axis=-1))

        return cost
