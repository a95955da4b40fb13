"""An evaluation for people: Markdown tables, and curves over the predicted frames."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from envs.files import written_aside
from worldmodel.scores import PICTURE_SCORES, SCORES, Score

Entry = Mapping[str, Any]
Rows = list[tuple[str, Entry]]
VARIANTS = (("latents_zero", "latents at 0"), ("posterior", "posterior mean"), ("without_motion", "without motion"))
"""Entries within a model's entry that get a row of their own."""
DRAWN = tuple(score for score in SCORES if score.name in PICTURE_SCORES and score.name != "inpainted")
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
        rows.append((name if _is_copy(entry) else f"{name}, {entry['prediction']}", entry))
        rows += [(f"{name}, {title}", entry[key]) for key, title in VARIANTS if entry.get(key)]
    return rows


def _is_copy(entry: Entry) -> bool:
    """Whether it is the last frame copied, whatever models are called."""
    prediction: str = entry["prediction"]
    return prediction.startswith("copy")


def _table(rows: Rows, scores: Sequence[Score]) -> list[str]:
    shown = [score for score in scores if any(entry.get(score.name) is not None for _, entry in rows)]
    lines = ["| | " + " | ".join(f"{score.title} {ARROWS[score.better]}" for score in shown) + " |"]
    lines.append("|---" * (len(shown) + 1) + "|")
    for title, entry in rows:
        lines.append("| " + " | ".join([title, *(_cell(entry, score) for score in shown)]) + " |")
    return lines


def _comparisons(models: Mapping[str, Entry]) -> list[str]:
    """Each model less copying and less those below it in the table."""
    pairs = [(f"{name} less {other}", gap) for name, e in models.items() for other, gap in e.get("less", {}).items()]
    shown = [s for s in SCORES if s.name in PICTURE_SCORES and any(s.name in gap for _, gap in pairs)]
    lines = ["| | " + " | ".join(f"{score.title} {ARROWS[score.better]}" for score in shown) + " |"]
    lines.append("|---" * (len(shown) + 1) + "|")
    for title, gap in pairs:
        cells = []
        for score in shown:
            one = gap.get(score.name, {})
            cells.append(_value(one.get("difference"), one.get("interval"), score.digits, "+"))
        lines.append("| " + " | ".join([title, *cells]) + " |")
    return lines if shown else []


def _cell(entry: Entry, score: Score) -> str:
    return _value(entry.get(score.name), entry["intervals"].get(score.name), score.digits)


def _value(value: float | None, interval: Sequence[float] | None, digits: int, sign: str = "") -> str:
    """A number and, where it is not a point, its interval."""
    if value is None:
        return "–"
    text = f"{value:{sign}.{digits}f}"
    ends = [f"{end:{sign}.{digits}f}" for end in interval or ()]
    return f"{text} [{', '.join(ends)}]" if len(set(ends)) > 1 else text


def line(name: str, entry: Entry) -> str:
    """One line, for when a model is done."""
    parts = [
        f"{score.title} {entry[score.name]:.{score.digits}f}"
        for score in SCORES
        if score.name in PICTURE_SCORES and entry[score.name] is not None
    ]
    return f"{name}: {'; '.join(parts)}"


def draw_curves(document: Mapping[str, Any], path: Path) -> None:
    """Scores over the predicted frames, one panel a score, as a PNG: models solid, with latents at 0 dotted where the
    best of many is drawn too, copying dashed."""
    from matplotlib.figure import Figure  # half a second: only where a figure is drawn

    models = document["models"]
    shown = [s for s in DRAWN if any(_drawable(entry["curves"].get(s.name)) for entry in models.values())]
    columns = min(3, max(len(shown), 1))
    height = -(-len(shown) // columns)
    figure = Figure(figsize=(3.8 * columns, 2.8 * height + 0.4), layout="constrained")
    panels = figure.subplots(height, columns, squeeze=False).flatten()
    for panel, score in zip(panels, shown, strict=False):
        for i, (name, entry) in enumerate(models.items()):
            colour, style = ("black", "--") if _is_copy(entry) else (f"C{i % 10}", "-")
            _draw(panel, entry, score, color=colour, linestyle=style, label=name)
            _draw(panel, entry.get("latents_zero"), score, color=colour, linestyle=":", label=f"{name}, latents at 0")
        panel.set_title(f"{score.title} {ARROWS[score.better]}", fontsize=9)
        panel.set_xlabel("predicted frame", fontsize=8)
        panel.tick_params(labelsize=8)
        panel.grid(alpha=0.3)
    for panel in panels[len(shown) :]:
        panel.set_axis_off()
    lines = {line.get_label(): line for panel in panels for line in panel.get_lines()}
    figure.legend(lines.values(), lines.keys(), loc="outside lower center", ncols=4, fontsize=8, frameon=False)
    with written_aside(path) as aside:
        figure.savefig(aside, format="png", dpi=100)


def _draw(panel: Any, entry: Entry | None, score: Score, **style: Any) -> None:
    curve = entry["curves"].get(score.name) if entry else None
    if curve is not None and _drawable(curve):
        panel.plot(range(1, len(curve) + 1), curve, marker=".", markersize=3, linewidth=1.2, **style)


def _drawable(curve: Sequence[float | None] | None) -> bool:
    return curve is not None and all(value is not None for value in curve)
