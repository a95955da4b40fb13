"""An evaluation for people: Markdown tables, and curves over the predicted frames."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from matplotlib.figure import Figure

from data_collection.files import written_aside
from worldmodel.scores import PICTURE_SCORES, SCORES, Score

Entry = Mapping[str, Any]
Rows = list[tuple[str, Entry]]
VARIANTS = (("latents_zero", "latents at 0"), ("posterior", "posterior mean"), ("without_motion", "without motion"))
"""Entries within a model's entry that get a row of their own."""
ARROWS = {"higher": "↑", "lower": "↓"}


def markdown(document: Mapping[str, Any]) -> str:
    """The whole report."""
    protocol, data, models = document["protocol"], document["data"], document["models"]
    intervals = f"95 % bootstrap interval over episodes ({protocol['resamples']} resamples)"
    lines = [
        "# Evaluation",
        "",
        f"{data['path']} ({data['env_id']}): {protocol['clips']} clips, {protocol['context']} frames seen, "
        f"{protocol['predicted']} predicted, free running. Scores are means over the predicted frames; in brackets the "
        f"{intervals}.",
        "",
        *_table(_rows(models), [score for score in SCORES if score.name in PICTURE_SCORES]),
    ]
    motion = [score for score in SCORES if score.name not in PICTURE_SCORES]
    moved = [(title, entry) for title, entry in _rows(models) if any(entry.get(s.name) is not None for s in motion)]
    if moved:
        lines += [
            "",
            "Motion against the simulator, one step ahead of true frames with latents at 0; TCP: at the end of the "
            "free-running clip. Relative: 1 is predicting no motion.",
            "",
            *_table(moved, motion),
        ]
    compared = _comparisons(models)
    if compared:
        lines += ["", "Differences on the same clips, episodes resampled together:", "", *compared]
    used = [(name, entry["latents"]) for name, entry in models.items() if entry.get("latents")]
    if used:
        head = "| latents | active units | KL(posterior, prior), nats | PSNR gain of the posterior mean, dB |"
        lines += ["", head, "|---|---|---|---|"]
        for name, use in used:
            lines.append(
                f"| {name} | {use['active']} of {use['units']} | {use['kl_nats']:.3f} | {use['psnr_gap']:+.2f} |"
            )
    return "\n".join([*lines, "", *(f"{note}." for note in protocol["notes"])]).rstrip() + "\n"


def _rows(models: Mapping[str, Entry]) -> Rows:
    """A row for each model, and for each further way in which it was made to predict."""
    rows: Rows = []
    for name, entry in models.items():
        rows.append((f"{name}, {entry['prediction']}" if name != entry["prediction"] else name, entry))
        rows += [(f"{name}, {title}", entry[key]) for key, title in VARIANTS if entry.get(key)]
    return rows


def _table(rows: Rows, scores: Sequence[Score]) -> list[str]:
    shown = [score for score in scores if any(entry.get(score.name) is not None for _, entry in rows)]
    lines = ["| | " + " | ".join(f"{score.title} {ARROWS[score.better]}" for score in shown) + " |"]
    lines.append("|---" * (len(shown) + 1) + "|")
    for title, entry in rows:
        lines.append("| " + " | ".join([title, *(_cell(entry, score) for score in shown)]) + " |")
    return lines


def _comparisons(models: Mapping[str, Entry]) -> list[str]:
    """Each model less those above it in the table and less copying."""
    pairs = [(f"{name} less {other}", gap) for name, e in models.items() for other, gap in e.get("less", {}).items()]
    shown = [s for s in SCORES if s.name in PICTURE_SCORES and any(s.name in gap for _, gap in pairs)]
    lines = ["| | " + " | ".join(f"{score.title} {ARROWS[score.better]}" for score in shown) + " |"]
    lines.append("|---" * (len(shown) + 1) + "|")
    for title, gap in pairs:
        cells = [_value(*gap[s.name].values(), s.digits, "+") if s.name in gap else "–" for s in shown]
        lines.append("| " + " | ".join([title, *cells]) + " |")
    return lines if shown else []


def _cell(entry: Entry, score: Score) -> str:
    return _value(entry.get(score.name), entry["intervals"].get(score.name), score.digits)


def _value(value: float | None, interval: Sequence[float] | None, digits: int, sign: str = "") -> str:
    """A number and, where it is not a point, its interval."""
    if value is None:
        return "–"
    text = f"{value:{sign}.{digits}f}"
    if interval and interval[0] != interval[1]:
        text += f" [{interval[0]:{sign}.{digits}f}, {interval[1]:{sign}.{digits}f}]"
    return text


def line(name: str, entry: Entry) -> str:
    """One line, for when a model is done."""
    parts = [
        f"{score.title} {entry[score.name]:.{score.digits}f}"
        for score in SCORES
        if score.name in PICTURE_SCORES and entry[score.name] is not None
    ]
    return f"{name}: {'; '.join(parts)}"


def draw_curves(document: Mapping[str, Any], path: Path) -> None:
    """Scores over the predicted frames, one panel a score, one line a row of the table, as a PNG."""
    rows = _rows(document["models"])
    shown = [s for s in SCORES if any(_drawable(entry["curves"].get(s.name)) for _, entry in rows)]
    columns = min(3, max(len(shown), 1))
    height = -(-len(shown) // columns)
    figure = Figure(figsize=(4.2 * columns, 3.1 * height + 0.3 * len(rows)), layout="constrained")
    axes = figure.subplots(height, columns, squeeze=False).flatten()
    for panel, score in zip(axes, shown, strict=False):
        for i, (title, entry) in enumerate(rows):
            curve = entry["curves"].get(score.name)
            if _drawable(curve):
                style = "--" if title.startswith("copy") else "-"
                panel.plot(range(1, len(curve) + 1), curve, style, color=f"C{i % 10}", label=title, marker=".", ms=3)
        panel.set_title(f"{score.title} {ARROWS[score.better]}", fontsize=9)
        panel.tick_params(labelsize=8)
        panel.grid(alpha=0.3)
        panel.set_xlabel("predicted frame", fontsize=8)
    for panel in axes[len(shown) :]:
        panel.set_axis_off()
    labels = {label: handle for panel in axes for handle, label in zip(*panel.get_legend_handles_labels(), strict=True)}
    figure.legend(labels.values(), labels.keys(), loc="outside lower left", fontsize=8, frameon=False)
    with written_aside(path) as aside:
        figure.savefig(aside, format="png", dpi=100)


def _drawable(curve: Sequence[float | None] | None) -> bool:
    return curve is not None and all(value is not None for value in curve)
