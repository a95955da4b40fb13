"""What a controller is, and the loop that all planning controllers share: plan, hold, plan again."""

from __future__ import annotations

import time
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from planning.costs import env_action
from planning.icem import ICEM, CostFunction

Observation = dict[str, Any]

TCP = slice(0, 3)  # position of the end-effector in `proprio`, metres, world
GRIPPER = 14  # last gripper command in `proprio`


@dataclass(frozen=True, eq=False)
class Goal:
    """Where the end-effector is to go.

    Attributes:
        point_world: (3,) float64, metres, world frame.
        pixel: (2,) float64, the same point in the picture (u, v), pixels.
    """

    point_world: NDArray[np.float64]
    pixel: NDArray[np.float64]


class Controller(Protocol):
    """Brings the end-effector to a goal, one action per control step."""

    name: str
    plan_seconds: list[float]

    def reset(self, observation: Observation, goal: Goal) -> None:
        """Start an episode with its first observation and its goal."""

    def act(self, observation: Observation) -> NDArray[np.float32]:
        """The next action (action_dim,) of the environment."""


class HoldingController:
    """Decides on a translation every `hold` control steps and holds it in between.

    A subclass says in `decide` which translation. The gripper keeps the command that it had at the start.

    Attributes:
        plan_seconds: wall time of each decision of the current episode.
    """

    name = "holding"

    def __init__(self, hold: int, action_dim: int = 7) -> None:
        self.hold = hold
        self.action_dim = action_dim
        self.plan_seconds: list[float] = []

    def reset(self, observation: Observation, goal: Goal) -> None:
        self.goal = goal
        self.gripper = held_gripper(observation)
        self.plan_seconds = []
        self._steps = 0

    def act(self, observation: Observation) -> NDArray[np.float32]:
        if self._steps % self.hold == 0:
            start = time.perf_counter()
            self.action = env_action(self.decide(observation), self.gripper, self.action_dim)
            self.plan_seconds.append(time.perf_counter() - start)
        self._steps += 1
        return self.action

    def decide(self, observation: Observation) -> NDArray:
        """The translation (3,) in [-1, 1] to hold from this observation on."""
        raise NotImplementedError


class PlanningController(HoldingController):
    """Searches the translations of the next few frames with iCEM and holds the first.

    A subclass says in `imagine` what a sequence of translations costs.
    """

    def __init__(self, planner: ICEM, hold: int, action_dim: int = 7) -> None:
        super().__init__(hold, action_dim)
        self.planner = planner

    def reset(self, observation: Observation, goal: Goal) -> None:
        super().reset(observation, goal)
        self.planner.reset()

    def decide(self, observation: Observation) -> NDArray:
        return self.planner.plan(self.imagine(observation)).actions[0]

    def imagine(self, observation: Observation) -> CostFunction:
        """The cost of sequences of held translations (N, horizon, 3), as a function, from this observation on."""
        raise NotImplementedError


def tcp_position(observation: Observation) -> NDArray[np.float64]:
    """The end-effector's measured position (3,) in the world, metres."""
    return np.asarray(observation["proprio"][TCP], np.float64)


def held_gripper(observation: Observation) -> float:
    """The command, -1 or 1, that keeps the gripper as it is."""
    return 1.0 if observation["proprio"][GRIPPER] >= 0 else -1.0
