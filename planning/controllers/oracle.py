"""The same planner with the simulator as its model: the upper bound."""

from __future__ import annotations

from typing import Any

import gymnasium as gym
import numpy as np
from numpy.typing import NDArray

from envs.tabletop.simulate import BatchSimulator
from planning.controllers.base import Observation, PlanningController
from planning.costs import discounted_distance, env_action
from planning.icem import ICEM, CostFunction


class OracleController(PlanningController):
    """Plans in copies of the simulator's state. It alone is given the environment.

    Args:
        env: the tabletop environment that is being controlled.
        simulator: of the same environment.
        planner: searches sequences of translations.
        hold: control steps that each translation is held for.
    """

    name = "oracle"

    def __init__(self, env: gym.Env, simulator: BatchSimulator, planner: ICEM, hold: int) -> None:
        super().__init__(planner, hold)
        self.simulator = simulator
        self.tabletop: Any = env.unwrapped

    def imagine(self, observation: Observation) -> CostFunction:
        state = self.tabletop.get_state()

        def cost(sequences: NDArray) -> NDArray:
            actions = np.repeat(env_action(sequences, self.gripper), self.hold, axis=1)  # (N, h * hold, 7)
            path = self.simulator.rollout_tcp(state, actions)
            reached = path[:, self.hold - 1 :: self.hold]  # (N, h, 3), after each held translation
            return discounted_distance(np.linalg.norm(reached - self.goal.point_world, axis=-1))

        return cost
