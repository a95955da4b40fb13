"""What a controller is, and the loop that all planning controllers share: plan, hold, plan again."""

from __future__ import annotations

import time
import warnings
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from envs.errors import UsageError
from planning.costs import Reach
from planning.effectors import Arm, Effector, held_gripper
from planning.followers import EffectorFollower, Follower
from planning.goals import Goal
from planning.icem import ICEM, CostFunction
from planning.observations import Observation

__all__ = ["Controller", "Goal", "HoldingController", "Observation", "PlanningController", "held_gripper"]

GOAL_NUMBERS = {"point_world": 3, "pixel": 2}
"""How many numbers a goal has, by what a controller knows of it."""


class Controller(Protocol):
    """Brings the designated point to a goal, one action per control step.

    Attributes:
        plan_seconds: wall time of each decision of the current episode; empty if it takes none down.
    """

    plan_seconds: list[float]

    def reset(self, observation: Observation, goal: Goal) -> None:
        """Start an episode with its first observation and its goal."""

    def act(self, observation: Observation) -> NDArray[np.float32]:
        """The next action (action_dim,) of the environment."""


class HoldingController:
    """Decides on a move every `hold` control steps and holds it in between.

    A subclass says in `decide` which move.

    Args:
        hold: control steps.
        effector: what is moved; the arm when None.
        follower: knows where the designated point is; when None it is the end-effector's own.

    Attributes:
        knows: what it knows of a goal, `point_world` or `pixel`.
        plan_seconds: wall time of each decision of the current episode.
    """

    knows = "point_world"

    def __init__(self, hold: int, effector: Effector | None = None, follower: Follower | None = None) -> None:
        self.hold = hold
        self.effector = effector or Arm()
        self.follower = follower or EffectorFollower(self.effector)
        self.plan_seconds: list[float] = []

    def reset(self, observation: Observation, goal: Goal) -> None:
        """See `Controller`.

        Raises:
            UsageError: the goal is no place, or the effector does not do with what is observed.
        """
        place, numbers = np.asarray(getattr(goal, self.knows), np.float64), GOAL_NUMBERS[self.knows]
        if place.shape != (numbers,) or not np.isfinite(place).all():
            raise UsageError(f"the goal's {self.knows} is {place.tolist()}; give {numbers} finite numbers")
        self.goal = goal
        self.effector.reset(observation)
        self.effector.check(observation)
        self.follower.reset(observation, goal)
        self.plan_seconds = []
        self._steps = 0

    def act(self, observation: Observation) -> NDArray[np.float32]:
        """See `Controller`.

        Raises:
            UsageError: there was no `reset`.
        """
        if not hasattr(self, "goal"):
            raise UsageError("act() before reset(): a controller does not know its goal yet; call reset first")
        start = time.perf_counter()
        self.follower.observe(observation)
        if self._steps % self.hold == 0:
            self.effector.aim(self.way())
            self.action = self.effector.action(self.decide(observation))
            self.plan_seconds.append(time.perf_counter() - start)
        self._steps += 1
        return self.action.copy()  # the caller may change it, and it is held

    def way(self) -> NDArray[np.float64]:
        """Where the point has yet to go (3,), metres, world frame, by what the controller knows."""
        return self.goal.point_world - self.follower.point

    def decide(self, observation: Observation) -> NDArray:
        """The move (axes,), within the effector's limit, to hold from this observation on."""
        raise NotImplementedError


class PlanningController(HoldingController):
    """Searches the moves of the next few frames with iCEM and holds the first.

    A subclass says in `imagine` what a sequence of moves costs.

    Args:
        planner: searches sequences of moves, within the effector's limit.
        hold, effector, follower: see `HoldingController`.
        reach: draws the end-effector to the thing that the point is on, if given.

    Raises:
        UsageError: the planner's bounds are no moves of the effector.
    """

    def __init__(
        self,
        planner: ICEM,
        hold: int,
        effector: Effector | None = None,
        follower: Follower | None = None,
        reach: Reach | None = None,
    ) -> None:
        super().__init__(hold, effector, follower)
        axes, limit = self.effector.axes, self.effector.limit
        if planner.low.shape != (axes,) or max(-planner.low.min(), planner.high.max()) > limit:
            raise UsageError(
                f"the planner searches from {planner.low.tolist()} to {planner.high.tolist()}, but a move of the"
                f" {type(self.effector).__name__} is {axes} numbers from {-limit} to {limit}; give such low and high"
            )
        if reach is not None:
            self.effector.check_follows_axes()
        self.planner, self.reach = planner, reach

    def reset(self, observation: Observation, goal: Goal) -> None:
        super().reset(observation, goal)
        self.planner.reset()

    def decide(self, observation: Observation) -> NDArray:
        plan = self.planner.plan(self.imagine(observation))
        if not np.isfinite(plan.cost):
            warnings.warn(
                f"{type(self).__name__} found no move of finite cost, and makes none: what it predicts is not finite,"
                " as with a model whose weights are not",
                RuntimeWarning,
                stacklevel=2,
            )
            return np.zeros(self.effector.axes)
        return plan.actions[0]

    def imagine(self, observation: Observation) -> CostFunction:
        """The cost of sequences of held moves (N, horizon, axes), as a function, from this observation on."""
        raise NotImplementedError
