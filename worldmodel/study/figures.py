"""A study as pictures: scores over the predicted frames, and bars."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from matplotlib.figure import Figure

from envs.files import written_aside
from worldmodel.evaluation_report import ARROWS
from worldmodel.scores import SCORES, Score
from worldmodel.study.paper import METRICS

_SCORES = [score for name in METRICS for score in SCORES if score.name == name]
_GREY = "0.45"
_COPY = "last frame copied"

Document = dict[str, Any]


def draw_curves(document: Document, path: Path) -> None:
    """One row of panels a frame gap, one panel a score, one line a model; copying the last frame is dashed."""
    gaps = sorted(int(gap) for gap in document["copy"])
    shown = [s for s in _SCORES if any(s.name in m["curves"] for m in document["models"].values())]
    figure = Figure(figsize=(2.9 * len(shown), 2.6 * len(gaps) + 0.5), layout="constrained")
    axes = figure.subplots(len(gaps), len(shown), squeeze=False)
    colours = _colours(document)
    for row, gap in zip(axes, gaps, strict=True):
        for panel, score in zip(row, shown, strict=True):
            for model in (m for m in document["models"].values() if m["frame_gap"] == gap):
                if score.name in model["curves"]:
                    curve = model["curves"][score.name]
                    panel.plot(range(1, len(curve) + 1), curve, color=colours[model["title"]], label=model["title"])
            curve = document["copy"][str(gap)]["curves"].get(score.name)
            if curve:
                panel.plot(range(1, len(curve) + 1), curve, "--", color=_GREY, label=_COPY)
            panel.set_title(f"{score.title} {ARROWS[score.better]}", fontsize=9)
            panel.tick_params(labelsize=8)
            panel.grid(alpha=0.3)
            for horizon in document["settings"]["horizons"][:-1]:
                panel.axvline(horizon, color=_GREY, lw=0.6, ls=":")
        row[0].set_ylabel(f"frame gap {gap}", fontsize=9)
    for panel in axes[-1]:
        panel.set_xlabel("predicted frame", fontsize=8)
    _legend_and_save(figure, axes, path)


def draw_bars(document: Document, path: Path) -> None:
    """One panel a score: each model's mean over the longest horizon with its 95 % interval; the dash is copying."""
    last = str(document["settings"]["horizons"][-1])
    gaps = sorted(int(gap) for gap in document["copy"])
    models = document["models"].values()
    shown = [s for s in _SCORES if any(m["horizons"][last][s.name] is not None for m in models)]
    colours = _colours(document)
    figure = Figure(figsize=(2.6 * len(shown), 3.1), layout="constrained")
    axes = figure.subplots(1, len(shown), squeeze=False)
    width = 0.8 / len(colours)
    for panel, score in zip(axes[0], shown, strict=True):
        heights: list[float] = []
        for at, gap in enumerate(gaps):
            for model in (m for m in models if m["frame_gap"] == gap):
                value = model["horizons"][last][score.name]
                if value is not None:
                    place = at - 0.4 + width * (list(colours).index(model["title"]) + 0.5)
                    ends = model["intervals"].get(score.name)
                    error = [[max(value - ends[0], 0)], [max(ends[1] - value, 0)]] if ends else None
                    panel.bar(
                        place, value, 0.92 * width, yerr=error, color=colours[model["title"]], label=model["title"],
                        error_kw={"elinewidth": 0.8},
                    )  # fmt: skip
                    heights += [value, *(ends or ())]
            copied = document["copy"][str(gap)]["horizons"][last][score.name]
            if copied is not None:
                panel.plot([at - 0.45, at + 0.45], [copied, copied], "--", color=_GREY, label=_COPY)
                heights.append(copied)
        _zoom(panel, heights, score)
        panel.set_xticks(range(len(gaps)), [f"gap {gap}" for gap in gaps])
        panel.set_title(f"{score.title} {ARROWS[score.better]}", fontsize=9)
        panel.tick_params(labelsize=8)
        panel.grid(axis="y", alpha=0.3)
        panel.set_axisbelow(True)
    _legend_and_save(figure, axes, path)


def _zoom(panel: Any, heights: list[float], score: Score) -> None:
    """Errors are shown from 0; likenesses, which never come near 0, from below the lowest."""
    if score.better == "higher":
        panel.set_ylabel("axis does not start at 0", fontsize=7, color=_GREY)
        low, high = min(heights), max(heights)
        margin = 0.15 * (high - low) or 0.1 * abs(high)
        panel.set_ylim(low - 2 * margin, high + margin)


def _colours(document: Document) -> dict[str, str]:
    titles = dict.fromkeys(model["title"] for model in document["models"].values())
    return {title: f"C{i}" for i, title in enumerate(titles)}


def _legend_and_save(figure: Figure, axes: Any, path: Path) -> None:
    handles = {
        label: handle
        for panel in axes.flatten()
        for handle, label in zip(*panel.get_legend_handles_labels(), strict=True)
    }
    labels = sorted(handles, key=lambda label: label == _COPY)  # the models in their order, then what is no model
    columns = min(len(labels), 7)
    figure.legend(
        [handles[label] for label in labels], labels, loc="outside lower center", ncols=columns, fontsize=8,
        frameon=False,
    )  # fmt: skip
    with written_aside(path) as aside:
        figure.savefig(aside, format="png", dpi=80)
