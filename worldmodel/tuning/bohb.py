"""BOHB (Falkner et al. 2018) without its own scheduler: the rungs of successive halving are its budgets."""

from __future__ import annotations

from typing import Any

import ConfigSpace
from ray.tune.search.bohb import TuneBOHB

from worldmodel.tuning.searchers import budget_of
from worldmodel.tuning.space import POWER, POWERS, Axis


class BOHBSearch(TuneBOHB):
    """Draws from a density of the configurations that did well at the largest budget that enough of them reached.

    Args:
        axes: of the search space.
        budgets: steps at which scores count; others are not told to BOHB.
        seed: of the draws before there is a density.
    """

    def __init__(self, axes: tuple[Axis, ...], budgets: tuple[int, ...], seed: int) -> None:
        space = ConfigSpace.ConfigurationSpace(seed=seed)
        for axis in axes:
            space.add(ConfigSpace.UniformFloatHyperparameter(axis.name, axis.low, axis.high, log=True))
        space.add(ConfigSpace.CategoricalHyperparameter(POWER, list(POWERS)))
        super().__init__(space, metric="score", mode="max", seed=seed)
        self._budgets = budgets
        self._heard: set[tuple[str, int]] = set()

    def set_search_properties(self, metric: str | None, mode: str | None, config: dict[str, Any], **spec: Any) -> bool:
        """It has its space already."""
        return True

    def on_trial_result(self, trial_id: str, result: dict[str, Any]) -> None:
        """Learn from a score at a rung, once: a trial that goes on tells its scores again."""
        budget = budget_of(result["step"], result["diverged"], self._budgets)
        if budget is not None and (trial_id, budget) not in self._heard:
            self._heard.add((trial_id, budget))
            super().on_trial_result(trial_id, {**result, "hyperband_info": {"budget": budget}})

    def on_trial_complete(self, trial_id: str, result: dict[str, Any] | None = None, error: bool = False) -> None:
        """Learn from the last score, which Ray tells here alone."""
        if result:
            self.on_trial_result(trial_id, result)
        super().on_trial_complete(trial_id, result, error)
