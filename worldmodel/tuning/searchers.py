"""Where the next configuration comes from: at random, or from a model of what did well (BOHB, HEBO)."""

from __future__ import annotations

import importlib
import json
from pathlib import Path
from typing import Any

import numpy as np
from ray import tune
from ray.tune.search import Searcher

from envs.errors import UsageError
from worldmodel.tuning.options import SearcherName
from worldmodel.tuning.space import POWER, POWERS, Axis, Point, draw

NEEDS: dict[str, tuple[str, ...]] = {"random": (), "bohb": ("hpbandster", "ConfigSpace"), "hebo": ("hebo",)}
"""Packages by the names under which they are imported."""
INSTALL = {
    "bohb": "pip install --constraint constraints.txt --editable '.[bohb]'",
    "hebo": "pip install HEBO where numpy is as old as it wants (below 1.25, says 0.3.6)",
}
SETTINGS = {"metric": "score", "mode": "max"}


def check_searcher(name: SearcherName) -> None:
    """See whether a searcher's packages are here.

    Raises:
        UsageError: one is not, or does not work.
    """
    for package in NEEDS[name]:
        try:
            importlib.import_module(package)
        except Exception as error:  # packages as old as these fail in many ways
            reason = (str(error) or type(error).__name__).splitlines()[0]
            raise UsageError(
                f"searcher {name} needs {package}, which cannot be imported here ({reason}); {INSTALL[name]}, or give "
                "--searcher random"
            ) from error


def make_searcher(
    name: SearcherName, axes: tuple[Axis, ...], first: Point, budgets: tuple[int, ...], seed: int
) -> Numbered:
    """A searcher that suggests `first` and then its own configurations.

    Raises:
        UsageError: its packages are not here.
    """
    check_searcher(name)
    inner: Searcher
    if name == "random":
        inner = RandomSearch(axes, seed)
    elif name == "bohb":
        from worldmodel.tuning.bohb import BOHBSearch

        inner = BOHBSearch(axes, budgets, seed)
    else:
        from ray.tune.search.hebo import HEBOSearch

        inner = HEBOSearch(random_state_seed=seed)
    return Numbered(inner, first)


def ray_space(axes: tuple[Axis, ...]) -> dict[str, Any]:
    """The search space as Ray Tune writes it."""
    space: dict[str, Any] = {axis.name: tune.loguniform(axis.low, axis.high) for axis in axes}
    return space | {POWER: tune.choice(list(POWERS))}


def budget_of(step: int, diverged: bool, budgets: tuple[int, ...]) -> int | None:
    """The budget at which a score counts, if any; after a divergence the one that was not reached, or the last."""
    if diverged:
        return min((budget for budget in budgets if budget > step), default=budgets[-1])
    return step if step in budgets else None


class Numbered(Searcher):
    """Gives every suggestion its `number`; number 0 is a point that is given.

    The inner searcher never hears of that one, which may lie outside of its ranges. It forgets one that failed, and
    does not hear how that ends when it is tried again.
    """

    def __init__(self, searcher: Searcher, first: Point) -> None:
        super().__init__(**SETTINGS)
        self.searcher, self._first = searcher, first
        self._count, self._first_id = 0, ""
        self._failed: set[str] = set()

    def set_search_properties(self, metric: str | None, mode: str | None, config: dict[str, Any], **spec: Any) -> bool:
        return bool(self.searcher.set_search_properties(metric, mode, config, **spec))

    def suggest(self, trial_id: str) -> dict[str, Any] | None:
        point = self._first if self._count == 0 else self.searcher.suggest(trial_id)
        if not isinstance(point, dict):
            return point  # nothing now, or nothing ever more
        if self._count == 0:
            self._first_id = trial_id
        self._count += 1
        plain = {
            name: int(value) if name == POWER else float(value) for name, value in point.items()
        }  # no numpy in JSON
        return {**plain, "number": self._count - 1}

    def on_trial_result(self, trial_id: str, result: dict[str, Any]) -> None:
        if self._known(trial_id):
            self.searcher.on_trial_result(trial_id, result)

    def on_trial_complete(self, trial_id: str, result: dict[str, Any] | None = None, error: bool = False) -> None:
        if self._known(trial_id):
            self.searcher.on_trial_complete(trial_id, result, error)
        if error:
            self._failed.add(trial_id)

    def get_state(self) -> dict[str, Any]:
        return {"count": self._count, "first_id": self._first_id, "failed": sorted(self._failed)}

    def set_state(self, state: dict[str, Any]) -> None:
        self._count, self._first_id = state["count"], state["first_id"]
        self._failed = set(state.get("failed", ()))  # searches from before there was such a thing have none

    def _known(self, trial_id: str) -> bool:
        """To the inner searcher."""
        return trial_id != self._first_id and trial_id not in self._failed


class RandomSearch(Searcher):
    """Draws configuration i from the seed and i alone, so that it is the same whatever else happens."""

    def __init__(self, axes: tuple[Axis, ...], seed: int) -> None:
        super().__init__(**SETTINGS)
        self._axes, self._seed, self._drawn = axes, seed, 0

    def set_search_properties(self, metric: str | None, mode: str | None, config: dict[str, Any], **spec: Any) -> bool:
        return True

    def suggest(self, trial_id: str) -> dict[str, Any]:
        self._drawn += 1
        return draw(self._axes, np.random.default_rng((self._seed, self._drawn)))

    def on_trial_complete(self, trial_id: str, result: dict[str, Any] | None = None, error: bool = False) -> None:
        """Chance learns nothing."""

    def save(self, checkpoint_path: str) -> None:
        Path(checkpoint_path).write_text(json.dumps({"drawn": self._drawn}))

    def restore(self, checkpoint_path: str) -> None:
        self._drawn = json.loads(Path(checkpoint_path).read_text())["drawn"]
