"""A search as pictures: rank correlations between budgets, and all trials as lines over the axes of the search."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib import colormaps
from matplotlib.colors import Normalize
from matplotlib.figure import Figure

from envs.files import written_aside
from worldmodel.tuning.correlation import written

Document = dict[str, Any]
_GREY = "0.75"
_MAP = "viridis_r"  # the better, the darker
LEAST_SPREAD_DB = 0.2
"""Scores that are nearer to each other look alike."""


def draw_correlations(document: Document, path: Path) -> None:
    """Save the paper's figure."""
    _save(correlation_figure(document), path)


def correlation_figure(document: Document) -> Figure:
    """The paper's figure: a cell for every pair of budgets with r, p and the number of configurations."""
    budgets = document["budgets"]
    size = len(budgets)
    values = np.full((size - 1, size - 1), np.nan)
    figure = Figure(figsize=(1.2 + 1.15 * (size - 1), 1.3 + 0.95 * (size - 1)), layout="constrained")
    axes = figure.subplots()
    for pair in document["shown"]:
        row, column = budgets.index(pair["budgets"][0]), budgets.index(pair["budgets"][1]) - 1
        if pair["r"] is None:
            text, dark = f"n = {pair['n']}", False
        else:
            values[row, column] = pair["r"]
            p = written(pair["p"])
            p = p if p.startswith("<") else f"= {p}"
            text, dark = f"r = {pair['r']:.3f}\np {p}\nn = {pair['n']}", pair["r"] > 0.6
        axes.text(column, row, text, ha="center", va="center", fontsize=8, color="white" if dark else "black")
    image = axes.imshow(values, vmin=-1, vmax=1, cmap="PuOr")
    axes.set_xticks(range(size - 1), [str(budget) for budget in budgets[1:]])
    axes.set_yticks(range(size - 1), [str(budget) for budget in budgets[:-1]])
    axes.set_xlabel("budget, steps", fontsize=9)
    axes.set_ylabel("smaller budget, steps", fontsize=9)
    axes.set_title(f"rank correlation ({document['shown_of']} trials)", fontsize=9)
    axes.tick_params(labelsize=8)
    figure.colorbar(image, ax=axes, shrink=0.8).ax.tick_params(labelsize=7)
    return figure


def draw_trials(document: Document, path: Path) -> None:
    """Parallel coordinates: each trial a line over the axes to its last score; colour is the score at the full budget.

    Grey lines did not come so far; the default is dashed, the best one thick.
    """
    budgets, names = document["budgets"], [*document["axes"], "power"]
    shown = [trial for trial in document["trials"] if trial["score"] is not None]
    whole = {t["number"]: t["scores"][str(budgets[-1])] for t in shown if str(budgets[-1]) in t["scores"]}
    most = max(whole.values(), default=0.0)
    colour = Normalize(min((most - LEAST_SPREAD_DB, *whole.values())), most)
    scales = [_Scale(np.array([*document["axes"][name], *(_at(t, name) for t in shown)]), True) for name in names[:-1]]
    scales += [_Scale(np.array([1.0, 2.0]), False), _Scale(np.array([t["score"] for t in shown]), False)]
    figure = Figure(figsize=(1.05 * len(scales), 3.6), layout="constrained")
    axes = figure.subplots()
    for trial in sorted(shown, key=lambda t: (t["number"] in whole, whole.get(t["number"], 0.0))):
        values = [*(_at(trial, name) for name in names), trial["score"]]
        heights = [scale(value) for scale, value in zip(scales, values, strict=True)]
        done = trial["number"] in whole
        best = document["best"] is not None and document["trials"][document["best"]] is trial
        axes.plot(
            range(len(scales)), heights, color=colormaps[_MAP](colour(whole[trial["number"]])) if done else _GREY,
            lw=2.6 if best else 1.2 if done else 0.7, ls="--" if trial["number"] == 0 else "-",
        )  # fmt: skip
    for place, scale in enumerate(scales):
        axes.axvline(place, color="0.3", lw=0.8)
        for height, text in ((0.0, scale.label(scale.low)), (1.0, scale.label(scale.high))):
            axes.text(
                place, -0.03 if height == 0 else 1.03, text, ha="center", va="bottom" if height else "top", fontsize=7
            )
    axes.set_xticks(range(len(scales)), [*(_title(name) for name in names), "last score,\ndB"])
    axes.tick_params(axis="x", labelsize=8, length=0, pad=12)
    axes.set_yticks([])
    axes.set_ylim(-0.02, 1.02)
    axes.spines[:].set_visible(False)
    if whole:
        bar = figure.colorbar(_mappable(colour), ax=axes, pad=0.02)
        bar.set_label(f"dB after {budgets[-1]} steps", fontsize=8)
        bar.ax.tick_params(labelsize=7)
    _save(figure, path)


def _at(trial: Document, name: str) -> float:
    """A trial's value on an axis; NaN where it has none, as trials of older searches."""
    return float(trial["point"].get(name, math.nan))


class _Scale:
    """From values to [0, 1]; NaN, a gap in a line, where a value has no place on the scale."""

    def __init__(self, values: Any, logarithmic: bool) -> None:
        values = values[values > 0] if logarithmic else values
        self.low, self.high, self._logarithmic = float(values.min()), float(values.max()), logarithmic

    def __call__(self, value: float) -> float:
        if self._logarithmic and not value > 0:
            return math.nan
        low, high, value = (np.log(x) if self._logarithmic else x for x in (self.low, self.high, value))
        return float((value - low) / (high - low)) if high > low else 0.5

    def label(self, value: float) -> str:
        """Two or three digits, in little room."""
        if self._logarithmic and value < 0.01:
            return f"{value:.1e}".replace(".0e", "e").replace("e-0", "e-")
        return f"{value:.3g}"


def _title(name: str) -> str:
    return {"power": "power\n(L1, L2)", "kl": "KL", "rgb": "RGB", "knn": "kNN"}.get(name, name.replace("_", "\n", 1))


def _mappable(colour: Normalize) -> Any:
    from matplotlib.cm import ScalarMappable

    return ScalarMappable(colour, _MAP)


def _save(figure: Figure, path: Path) -> None:
    with written_aside(path) as aside:
        figure.savefig(aside, format="png", dpi=100)
