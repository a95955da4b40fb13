"""What an evaluation comes to: the table and `servo.json`."""

from __future__ import annotations

import itertools
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from planning.episode import Record
from planning.statistics import wilson_interval

AXIS_SPLIT = 0.5  # share of the way along the optical axis that parts "across" from "along"
AXIS_BINS = (0.0, 0.25, 0.5, 0.75, 1.0)  # bounds of a finer division by that share
AXIS_PARTS = ("across", "along")
PARTINGS = (AXIS_PARTS, ("behind", "round"), ("open", "shut"))
"""What the setups of a task fall into: two parts."""
TITLES = {
    "all": "all",
    "across": "across the optical axis",
    "along": "along it",
    "behind": "tip starts behind the object",
    "round": "tip has to go round",
    "open": "drawer to be opened",
    "shut": "drawer to be shut",
}


def summarise(records: Sequence[Record], whole: bool = False) -> dict[str, Any]:
    """One model's entry in `servo.json`; distances in metres, shares in [0, 1], intervals of 95 % (Wilson).

    Args:
        records: of its episodes.
        whole: whether they went on to their last step.
    """
    summary: dict[str, Any] = {"episodes": len(records), "setups": len({record.setup for record in records})}
    limits = records[0].limits
    for space in ("2d", "3d"):
        hits = [record.reached(space) for record in records]
        summary[f"success_{space}"] = float(np.mean(hits))
        summary[f"success_{space}_interval"] = _success_interval(records, space)
        summary[f"success_{space}_at"] = {
            str(limit): float(np.mean([record.success(limit, space) for record in records])) for limit in limits
        }
    summary["final_distance_m_median"] = float(np.median([record.final_distance for record in records]))
    if whole:
        summary["stay_distance_m_median"] = float(np.median([record.stay for record in records]))
    summary["least_distance_m_median"] = float(np.median([record.least_distance for record in records]))
    summary["initial_distance_m_median"] = float(np.median([record.initial_distance for record in records]))
    summary["plan_seconds_median"] = float(np.median([record.plan_seconds for record in records]))
    parts = parting(records)
    by_part = {part: _share([record for record in records if in_part(record, part)]) for part in parts}
    if parts != AXIS_PARTS:
        return {**summary, "by_part": by_part}
    summary["by_axis_share"] = by_part
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


def parting(records: Sequence[Record]) -> tuple[str, str]:
    """The two parts that the setups of these episodes fall into."""
    return next((parts for parts in PARTINGS if records[0].part in parts), AXIS_PARTS)


def in_part(record: Record, part: str) -> bool:
    """Whether an episode is of a part of the setups; all are of `all`."""
    own = record.part or AXIS_PARTS[int(record.axis_share >= AXIS_SPLIT)]
    return part in ("all", own)


def parts_of(entry: Mapping[str, Any]) -> dict[str, dict[str, Any]]:
    """The entries of the two parts, of a model's entry in `servo.json`."""
    parts: dict[str, dict[str, Any]] = entry["by_axis_share"] if "by_axis_share" in entry else entry["by_part"]
    return parts


def _share(records: Sequence[Record]) -> dict[str, Any]:
    """Successes of a part of the episodes, which may be empty."""
    part: dict[str, Any] = {"episodes": len(records)}
    for space in ("2d", "3d"):
        hits = sum(record.reached(space) for record in records)
        part[f"success_{space}"] = hits / len(records) if records else None
        part[f"success_{space}_interval"] = _success_interval(records, space)
    return part


def _success_interval(records: Sequence[Record], space: str) -> list[float]:
    """Wilson's, in which all episodes of a setup are one observation."""
    setups = len({record.setup for record in records})
    hits = sum(record.reached(space) for record in records)
    return list(wilson_interval(hits * setups / max(len(records), 1), setups))


def table(models: dict[str, dict[str, Any]]) -> str:
    """The summaries as text, one model a line."""
    some = next(iter(models.values()))
    tighter, parts = list(some["success_3d_at"])[1:], list(parts_of(some))
    share = "by_axis_share" in some
    at = [f"at-{100 * float(limit):g}%" if share else f"at-{1000 * float(limit):g}mm" for limit in tighter]
    distances = {"final-m": "final_distance_m_median", "stay-m": "stay_distance_m_median"}
    distances = {title: key for title, key in distances.items() if key in some}
    rows = [["model", "episodes", "3D", "95%", *at, "2D", "95%", *distances, "s/plan", *parts]]
    for name, entry in models.items():
        rows.append(
            [
                name,
                str(entry["episodes"]),
                _percent(entry["success_3d"]),
                _interval(entry["success_3d_interval"]),
                *(_percent(entry["success_3d_at"][limit]) for limit in tighter),
                _percent(entry["success_2d"]),
                _interval(entry["success_2d_interval"]),
                *(f"{entry[key]:.3f}" for key in distances.values()),
                f"{entry['plan_seconds_median']:.4f}",
                *(_percent(parts_of(entry)[part]["success_3d"]) for part in parts),
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
