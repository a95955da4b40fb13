"""Asynchronous successive halving (ASHA, Li et al. 2020) that spares some trials and outlives its process."""

from __future__ import annotations

import json
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

from ray.tune.schedulers import ASHAScheduler, TrialScheduler

from worldmodel.tuning import journal
from worldmodel.tuning.space import Point


class Halving(ASHAScheduler):
    """At each rung, stops a trial that is not among the best 1/reduction of those that have been there.

    Ray does not keep a scheduler's state: a search that goes on would begin with empty rungs. Here they are filled from
    the journal, where a trial is known by its configuration. Results carry `step` and `diverged`.

    Args:
        results: the journal.
        budgets: steps at the rungs, and in all.
        reduction: how much less goes on at each rung.
        spared: trials with smaller numbers run to the end; their scores count at the rungs.
    """

    def __init__(self, results: Path, budgets: tuple[int, ...], reduction: int, spared: int) -> None:
        super().__init__(time_attr="step", max_t=budgets[-1], grace_period=budgets[0], reduction_factor=reduction)
        self._results, self._budgets, self._spared = results, budgets, spared
        self._ended: dict[str, int] | None = None

    def on_trial_add(self, tune_controller: Any, trial: Any) -> None:
        """As in Ray; before the first one, the rungs are filled."""
        if self._ended is None:
            self._ended = {}
            self._recall(self._ended)
        super().on_trial_add(tune_controller, _known(trial))

    def on_trial_result(self, tune_controller: Any, trial: Any, result: dict[str, Any]) -> str:
        """Whether to go on."""
        known, step = _known(trial), int(result["step"])
        if result["diverged"] or step >= (self._ended or {}).get(known.trial_id, self._budgets[-1]):
            return str(TrialScheduler.STOP)
        action = super().on_trial_result(tune_controller, known, result)
        return str(TrialScheduler.CONTINUE if trial.config["number"] < self._spared else action)

    def on_trial_complete(self, tune_controller: Any, trial: Any, result: dict[str, Any]) -> None:
        """As in Ray."""
        super().on_trial_complete(tune_controller, _known(trial), result)

    def on_trial_remove(self, tune_controller: Any, trial: Any) -> None:
        """As in Ray."""
        super().on_trial_remove(tune_controller, _known(trial))

    def _recall(self, ended: dict[str, int]) -> None:
        for before in journal.trials(self._results):
            known, nobody = _as_known(before.point), cast(Any, None)
            super().on_trial_add(nobody, known)
            for step in sorted(set(before.scores) & set(self._budgets[:-1])):
                super().on_trial_result(nobody, known, {"step": step, self._metric: before.scores[step]})
            super().on_trial_remove(nobody, known)
            if before.status in journal.ENDED:
                ended[known.trial_id] = before.step


def _known(trial: Any) -> Any:
    return _as_known({name: value for name, value in trial.config.items() if name != "number"})


def _as_known(point: Point) -> Any:
    """What Ray's scheduler knows a trial by: its configuration in place of an id that changes."""
    return SimpleNamespace(trial_id=json.dumps(point, sort_keys=True))
