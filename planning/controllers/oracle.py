"""The same planner with the true dynamics: the simulator is its model."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from planning.controllers.base import Observation, PlanningController
from planning.costs import discounted_distance
from planning.icem import ICEM, CostFunction
from planning.marks import Mark
from planning.what_if import WhatIf


class OracleController(PlanningController):
    """Plans in copies of the simulator's state. It alone is given the simulator, and where the point truly is.

    Args:
        what_if: the simulator.
        mark: the designated point; None for the end-effector's.
        planner, hold, options: see `PlanningController`.
    """

    def __init__(self, what_if: WhatIf, mark: Mark | None, planner: ICEM, hold: int, **options: Any) -> None:
        super().__init__(planner, hold, **options)
        self.what_if, self.mark = what_if, mark

    def imagine(self, observation: Observation) -> CostFunction:
        state = self.what_if.state()

        def cost(sequences: NDArray) -> NDArray:
            actions = np.repeat(self.effector.action(sequences), self.hold, axis=1)  # (N, h * hold, A)
            paths = self.what_if.paths(state, actions, self.mark)
            after = slice(self.hold - 1, None, self.hold)  # each held move
            effector, point = paths.effector[:, after], paths.point[:, after]  # (N, h, 3)
            distances = np.linalg.norm(point - self.goal.point_world, axis=-1)
            if self.reach:
                distances = distances + self.reach.cost(effector, point, self.goal.point_world)
            return discounted_distance(distances)

        return cost
