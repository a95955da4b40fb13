"""Controllers without a world model: what servoing takes, and what it does not."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from envs.tabletop.control import ACTION_SCALE
from planning.controllers.base import Goal, HoldingController, Observation, PlanningController
from planning.costs import discounted_distance
from planning.effectors import Effector
from planning.followers import Follower
from planning.icem import ICEM, CostFunction

METRES_PER_ACTION = ACTION_SCALE[0]  # of a full translation of the arm over one control step


class RandomController(HoldingController):
    """Uniform moves, held as long as a planned one: the lower bound."""

    def __init__(self, hold: int, rng: np.random.Generator, effector: Effector | None = None) -> None:
        super().__init__(hold, effector)
        self.rng = rng

    def reset(self, observation: Observation, goal: Goal) -> None:
        super().reset(observation, replace(goal, designated=None))  # it does not look

    def decide(self, observation: Observation) -> NDArray:
        return self.rng.uniform(-self.effector.limit, self.effector.limit, self.effector.axes)


class ProportionalController(HoldingController):
    """Moves as the point is to move, straight towards the goal; decides at every control step.

    It knows the units of the actions, and nothing of how the point moves when the end-effector does. That is enough
    where the point is the end-effector's own.

    Args:
        effector, follower: see `HoldingController`.
        gain: share of the remaining way that is commanded per step.
    """

    def __init__(self, effector: Effector | None = None, follower: Follower | None = None, gain: float = 0.5) -> None:
        super().__init__(1, effector, follower)
        self.effector.check_follows_axes()
        self.gain = gain

    def decide(self, observation: Observation) -> NDArray:
        way = (self.goal.point_world - self.follower.point)[: self.effector.axes]
        move = self.gain * way / self.effector.metres
        return move / max(1.0, np.abs(move).max() / self.effector.limit)


class LinearController(PlanningController):
    """Plans with a linear model `motion of the point = B @ move`, fitted by least squares while the episode runs.

    It knows nothing to begin with: its first decisions move along each axis in turn, and from then on every decision
    refits B to the whole episode. What it costs to learn the arm anew is thus inside the budget of steps.
    """

    ridge = 1e-6  # keeps the fit defined; in squared action units, against probes of size 1

    def __init__(self, planner: ICEM, hold: int, effector: Effector | None = None, **options: Any) -> None:
        super().__init__(planner, hold, effector, **options)
        self.effector.check_follows_axes()

    def reset(self, observation: Observation, goal: Goal) -> None:
        super().reset(observation, goal)
        self._moves: list[NDArray] = []
        self._positions: list[NDArray] = []

    def decide(self, observation: Observation) -> NDArray:
        self._positions.append(np.array(self.follower.point))
        axes = self.effector.axes
        way = (self.goal.point_world - self._positions[0])[:axes]
        probes = self.effector.limit * np.eye(axes) * np.sign(way)[:, None]
        tried = len(self._moves)
        move = probes[tried] if tried < len(probes) else super().decide(observation)
        self._moves.append(move)
        return move

    def imagine(self, observation: Observation) -> CostFunction:
        moves = np.array(self._moves)
        motions = np.diff(self._positions, axis=0)
        transposed = np.linalg.solve(moves.T @ moves + self.ridge * np.eye(moves.shape[1]), moves.T @ motions)  # B^T

        def cost(sequences: NDArray) -> NDArray:
            ways = np.cumsum(sequences @ transposed, axis=1)
            positions = np.asarray(self._positions[-1] + ways, np.float64)  # (N, h, 3)
            distances = np.linalg.norm(positions - self.goal.point_world, axis=-1)
            if self.reach:
                effector = self.effector.path(observation, sequences, self.hold)
                distances = distances + self.reach.cost(effector, positions, self.goal.point_world)
            return discounted_distance(distances)

        return cost
