"""Models against each other: over the same setups, and by parts of them.

A model of pictures is blind along the optical axis. So the share of the way that lies along it says which setups such
a model can get right in 3D by reaching the pixel, and which only by chance.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from envs.files import written_aside
from planning.episode import Record
from planning.report import AXIS_BINS, TITLES, aligned, in_part, parting, parts_of
from planning.statistics import Pairs, sign_flip_p

if TYPE_CHECKING:
    from matplotlib.axes import Axes

REFERENCE = "t3vip"
"""Whom the others are compared with."""

COLOURS = {
    "t3vip": "#1f4e79",
    "sv2p": "#d1662a",
    "sna": "#e0a53c",
    "cdna": "#a8423f",
    "oracle": "#5a9a55",
    "linear": "#7b68a6",
    "proportional": "#b08fc7",
    "random": "#9a9a9a",
}
SPACES = {"2d": "pixel reached (2D)", "3d": "point reached (3D)"}


def differences(records: Mapping[str, Sequence[Record]]) -> dict[str, dict[str, Any]]:
    """What T3VIP has over each other model, on the same episodes; nothing where T3VIP is not among them.

    Args:
        records: of each model, of the same setups and repeats in the same order.

    Returns:
        rival -> part of the setups (all, and both parts) -> `servo.json`'s entry: the difference of the success rates
        with Newcombe's 95 % interval, who alone succeeded how often, and the p-value of McNemar's exact test. Of both
        the repeats of a setup are one observation.
    """
    if REFERENCE not in records:
        return {}
    return {
        rival: {part: _paired(records[REFERENCE], theirs, part) for part in ("all", *parting(theirs))}
        for rival, theirs in records.items()
        if rival != REFERENCE
    }


def _paired(ours: Sequence[Record], theirs: Sequence[Record], part: str) -> dict[str, Any]:
    couples = [(a, b) for a, b in zip(ours, theirs, strict=True) if in_part(a, part)]
    entry: dict[str, Any] = {"episodes": len(couples)}
    for space in SPACES:
        pairs = Pairs.count(*([record.reached(space) for record in side] for side in _unzip(couples)))
        lead: Counter[int] = Counter()  # by setup
        for a, b in couples:
            lead[a.setup] += a.reached(space) - b.reached(space)
        entry[f"difference_{space}"] = pairs.difference
        entry[f"difference_{space}_interval"] = list(pairs.counting_as(len(lead)).interval())
        entry[f"only_{REFERENCE}_{space}"], entry[f"only_rival_{space}"] = pairs.first, pairs.second
        entry[f"p_{space}"] = sign_flip_p(list(lead.values()))
    return entry


def _unzip(couples: list[tuple[Record, Record]]) -> tuple[list[Record], list[Record]]:
    return [a for a, _ in couples], [b for _, b in couples]


def difference_table(entries: Mapping[str, Mapping[str, Any]]) -> str:
    """The differences as text, in points of success; a rival and a part of the setups a line."""
    rows = [[f"{REFERENCE} less", "way", "episodes", "3D", "95%", "p", "2D", "95%", "p"]]
    for rival, parts in entries.items():
        for part, entry in parts.items():
            row = [rival, part, str(entry["episodes"])]
            for space in ("3d", "2d"):
                low, high = (f"{100 * bound:+.0f}" for bound in entry[f"difference_{space}_interval"])
                difference = entry[f"difference_{space}"]
                row += [
                    "-" if difference is None else f"{100 * difference:+.0f}",
                    f"{low} to {high}",
                    f"{entry[f'p_{space}']:.2g}",
                ]
            rows.append(row)
    return aligned(rows)


def success_chart(models: Mapping[str, Mapping[str, Any]], path: Path, title: str) -> None:
    """Draw success in 2D and 3D, and both by parts of the setups, as a PNG.

    Where the setups differ by the share of the way along the optical axis, both are drawn against that share.

    Args:
        models: name -> summary, as in `servo.json`.
        path: of the picture.
        title: of the first panel.
    """
    from matplotlib.figure import Figure  # half a second: only where a figure is drawn

    figure = Figure(figsize=(11, 3.9), layout="constrained")
    overall, *beside = figure.subplots(1, 3, sharey=True, width_ratios=(1.15, 1, 1))
    some = next(iter(models.values()))
    _draw_bars(overall, {name: [entry, entry] for name, entry in models.items()}, list(SPACES), list(SPACES.values()))
    overall.set_ylabel("success [%]")
    overall.set_title(title, fontsize=10)
    for axes, (space, label) in zip(beside, SPACES.items(), strict=True):
        if "by_axis_bin" in some:
            _draw_by_share(axes, models, space)
        else:
            parts = {name: list(parts_of(entry).values()) for name, entry in models.items()}
            counts = [f"{TITLES[part]}\nn={entry['episodes']}" for part, entry in parts_of(some).items()]
            _draw_bars(axes, parts, [space] * 2, counts)
        axes.set_title(label, fontsize=10)
    for axes in (overall, *beside):
        axes.set_ylim(0, 105)
        axes.grid(axis="y", alpha=0.3)
        axes.set_axisbelow(True)
    handles, names = overall.get_legend_handles_labels()
    figure.legend(handles, names, loc="outside lower center", ncols=len(models), frameon=False, fontsize=9)
    with written_aside(path) as aside:
        figure.savefig(aside, format="png", dpi=150)


def _draw_bars(
    axes: Axes, groups: Mapping[str, Sequence[Mapping[str, Any]]], spaces: Sequence[str], labels: Sequence[str]
) -> None:
    """A bar for each model in each group: its entries, and in which space they count."""
    width = 0.84 / len(groups)
    for i, (name, entries) in enumerate(groups.items()):
        shares, errors = _bounds(entries, spaces)
        places = np.arange(len(entries)) + (i - (len(groups) - 1) / 2) * width
        colour = COLOURS.get(name, "#444444")
        axes.bar(places, shares, 0.9 * width, yerr=errors, capsize=2.5, error_kw={"lw": 1}, color=colour, label=name)
    axes.set_xticks(range(len(labels)), labels, fontsize=9)


def _draw_by_share(axes: Axes, models: Mapping[str, Mapping[str, Any]], space: str) -> None:
    """A line for each model against the share of the way along the optical axis."""
    for i, (name, entry) in enumerate(models.items()):
        bins = entry["by_axis_bin"]
        shares, errors = _bounds(bins, [space] * len(bins))
        places = np.arange(len(bins)) + (i - (len(models) - 1) / 2) * 0.6 / len(models)
        look = {"fmt": "o-", "ms": 4, "lw": 1.2, "elinewidth": 1, "capsize": 2, "color": COLOURS.get(name, "#444444")}
        axes.errorbar(places, shares, errors, label=name, **look)  # type: ignore[arg-type]
    counts = [part["episodes"] for part in next(iter(models.values()))["by_axis_bin"]]
    ticks = [f"{low:g}-{high:g}\nn={n}" for low, high, n in zip(AXIS_BINS[:-1], AXIS_BINS[1:], counts, strict=True)]
    axes.set_xticks(range(len(ticks)), ticks, fontsize=8)
    axes.set_xlabel("share of the way along the optical axis", fontsize=9)


def _bounds(parts: Sequence[Mapping[str, Any]], spaces: Sequence[str]) -> tuple[np.ndarray, np.ndarray]:
    """Success rates in percent and how far their intervals reach below and above; NaN where nothing was tried."""
    shares = np.array([part[f"success_{space}"] for part, space in zip(parts, spaces, strict=True)], float)
    ends = np.array([part[f"success_{space}_interval"] for part, space in zip(parts, spaces, strict=True)])
    return 100 * shares, 100 * np.clip([shares - ends[:, 0], ends[:, 1] - shares], 0, None)
