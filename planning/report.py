"""What an evaluation comes to: the table, `servo.json`, and the bar chart."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from data_collection.files import written_aside
from planning.episode import THRESHOLDS, Record
from planning.statistics import wilson_interval

AXIS_SPLIT = 0.5  # share of the way along the optical axis that parts "across" from "along"
AXIS_BINS = (0.0, 0.25, 0.5, 0.75, 1.0)  # bounds of a finer division by that share
PARTS = ("all", "across", "along")


def summarise(records: Sequence[Record]) -> dict[str, Any]:
    """One model's entry in `servo.json`; distances in metres, shares in [0, 1], intervals of 95 % (Wilson)."""
    summary: dict[str, Any] = {"episodes": len(records), "setups": len({record.setup for record in records})}
    for space in ("2d", "3d"):
        hits = [record.success(THRESHOLDS[0], space) for record in records]
        summary[f"success_{space}"] = float(np.mean(hits))
        summary[f"success_{space}_interval"] = list(wilson_interval(sum(hits), len(hits)))
        summary[f"success_{space}_at"] = {
            str(threshold): float(np.mean([record.success(threshold, space) for record in records]))
            for threshold in THRESHOLDS
        }
    summary["final_distance_m_median"] = float(np.median([record.final_distance for record in records]))
    summary["least_distance_m_median"] = float(np.median([record.least_distance for record in records]))
    summary["initial_distance_m_median"] = float(np.median([record.initial_distance for record in records]))
    summary["plan_seconds_median"] = float(np.median([record.plan_seconds for record in records]))
    summary["by_axis_share"] = {part: _share([r for r in records if in_part(r, part)]) for part in PARTS[1:]}
    numbers = np.digitize([record.axis_share for record in records], AXIS_BINS[1:-1])
    summary["by_axis_bin"] = [
        {
            "from": low,
            "to": high,
            **_share([record for record, at in zip(records, numbers, strict=True) if at == number]),
        }
        for number, (low, high) in enumerate(itertools.pairwise(AXIS_BINS))
    ]
    return summary


def in_part(record: Record, part: str) -> bool:
    """Whether an episode is one of the `across` or `along` setups; all are of `all`."""
    return part == "all" or (part == "along") == (record.axis_share >= AXIS_SPLIT)


def _share(records: Sequence[Record]) -> dict[str, Any]:
    """Successes of a part of the episodes, which may be empty."""
    part: dict[str, Any] = {"episodes": len(records)}
    for space in ("2d", "3d"):
        hits = sum(record.success(THRESHOLDS[0], space) for record in records)
        part[f"success_{space}"] = hits / len(records) if records else None
        part[f"success_{space}_interval"] = list(wilson_interval(hits, len(records)))
    return part


def table(models: dict[str, dict[str, Any]]) -> str:
    """The summaries as text, one model a line."""
    head = ["model", "episodes", "3D", "95%", "at-5%", "at-2.5%", "2D", "95%", "final-m", "s/plan", "across", "along"]
    rows = [head]
    for name, entry in models.items():
        at, axis = entry["success_3d_at"], entry["by_axis_share"]
        rows.append(
            [
                name,
                str(entry["episodes"]),
                _percent(entry["success_3d"]),
                _interval(entry["success_3d_interval"]),
                *(_percent(at[str(threshold)]) for threshold in THRESHOLDS[1:]),
                _percent(entry["success_2d"]),
                _interval(entry["success_2d_interval"]),
                f"{entry['final_distance_m_median']:.3f}",
                f"{entry['plan_seconds_median']:.4f}",
                _percent(axis["across"]["success_3d"]),
                _percent(axis["along"]["success_3d"]),
            ]
        )
    return aligned(rows)


def aligned(rows: Sequence[Sequence[str]]) -> str:
    """A table as text, its columns flush right."""
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    return "\n".join("  ".join(cell.rjust(width) for cell, width in zip(row, widths, strict=True)) for row in rows)


def _percent(share: float | None) -> str:
    return "-" if share is None else f"{100 * share:.0f} %"


def _interval(interval: Sequence[float]) -> str:
    return f"{100 * interval[0]:.0f}-{100 * interval[1]:.0f}"


def bar_chart(models: dict[str, dict[str, Any]], path: Path, title: str) -> None:
    """Draw success in 2D and 3D, and 3D success by the way's direction, with 95 % intervals, as a PNG."""
    figure = Figure(figsize=(4 + 1.6 * len(models), 3.8), layout="constrained")
    overall, split = figure.subplots(1, 2, sharey=True)
    _bars(overall, models, {"2D": lambda m: (m, "2d"), "3D": lambda m: (m, "3d")}, ("#9bb7d4", "#1f4e79"))
    sides = {
        "across the optical axis": lambda m: (m["by_axis_share"]["across"], "3d"),
        "along it": lambda m: (m["by_axis_share"]["along"], "3d"),
    }
    _bars(split, models, sides, ("#b9d8b4", "#2f6b2a"))
    overall.set_ylabel("success [%]")
    overall.set_title(title, fontsize=10)
    split.set_title("3D, by the direction of the way", fontsize=10)
    with written_aside(path) as aside:
        figure.savefig(aside, format="png", dpi=150)


def _bars(axes: Any, models: dict[str, dict[str, Any]], series: dict[str, Any], colours: Sequence[str]) -> None:
    width = 0.8 / len(series)
    for i, (label, pick) in enumerate(series.items()):
        parts = [pick(entry) for entry in models.values()]
        height = np.array([100 * (part[f"success_{space}"] or 0) for part, space in parts])
        low, high = 100 * np.array([part[f"success_{space}_interval"] for part, space in parts]).T
        places = np.arange(len(models)) + (i - (len(series) - 1) / 2) * width
        errors = np.clip([height - low, high - height], 0, None)
        axes.bar(places, height, 0.92 * width, yerr=errors, capsize=3, label=label, color=colours[i])
    axes.set_xticks(range(len(models)), list(models))
    axes.set_ylim(0, 105)
    axes.grid(axis="y", alpha=0.3)
    axes.set_axisbelow(True)
    axes.legend(fontsize=8, loc="upper center", bbox_to_anchor=(0.5, -0.08), ncols=len(series), frameon=False)
