"""What a search has found so far: `report.json`, `report.md`, two pictures, and `best.json` to train with."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from envs.errors import UsageError
from envs.files import write_json, written_aside
from worldmodel.tuning import journal
from worldmodel.tuning.correlation import FEWEST, rank_correlations, written
from worldmodel.tuning.journal import PARTS, Trial
from worldmodel.tuning.search import SETTINGS
from worldmodel.tuning.space import as_options

FILES = ("report.json", "report.md", "trials.png", "rank-correlation.png", "best.json")

Document = dict[str, Any]
_HEADINGS = dict(zip(PARTS, ("RGB, dB", "depth, dB", "flow error", "TCP off"), strict=True))
WORSE = 1.2
"""Motion that is so many times as wrong as the preset's is pointed out."""
_MOTION = {"flow_error_moving": "scene-flow error on what moves", "tracking_error": "TCP off, as a share of its way"}


def write_report(out: Path) -> Document:
    """Write all of `FILES` that there is something to say in; returns what `report.json` holds.

    Args:
        out: folder of a search, finished or not.

    Raises:
        UsageError: there is none, or it is damaged.
    """
    path = out / SETTINGS
    if not path.is_file():
        raise UsageError(f"no search in {out}; give the --out of tune-worldmodel")
    try:
        settings = json.loads(path.read_text())
        document = summarise(settings, journal.trials(out / journal.JOURNAL))
    except (ValueError, KeyError, TypeError, AttributeError) as error:
        raise UsageError(f"the search in {out} is damaged ({type(error).__name__}: {error}); restore it") from error
    write_json(out / "report.json", document)
    with written_aside(out / "report.md") as aside:
        aside.write_text(markdown(document))
    from worldmodel.tuning import figures  # half a second: only where a figure is drawn

    if any(trial["score"] is not None for trial in document["trials"]):
        figures.draw_trials(document, out / "trials.png")
    if any(pair["r"] is not None for pair in document["shown"]):
        figures.draw_correlations(document, out / "rank-correlation.png")
    if document["best"] is not None:
        best = document["trials"][document["best"]]
        options = as_options(best["point"])
        shared = settings["shared"]
        losses = {**shared.get("losses", {}), **options["losses"]}
        write_json(out / "best.json", shared | options | {"losses": losses})
    return document


def summarise(settings: Document, trials: list[Trial]) -> Document:
    """The report: all trials, the best of those that ran to the end, and rank correlations.

    Args:
        settings: what `tune.json` holds.
        trials: by number.
    """
    budgets, spared = settings["budgets"], settings["options"]["unpruned"]
    whole = [trial for trial in trials if budgets[-1] in trial.scores]
    best = max(whole, key=lambda trial: trial.scores[budgets[-1]], default=None)
    unpruned = [trial for trial in trials if trial.number < spared]
    correlations = {"all": rank_correlations(trials, budgets), "unpruned": rank_correlations(unpruned, budgets)}
    fair = any(pair["n"] >= FEWEST for pair in correlations["unpruned"])
    return {
        "budgets": budgets,
        "axes": settings["axes"],
        "around": settings["options"].get("around"),
        "shared": {name: value for name, value in settings["shared"].items() if name not in ("preset", "model")},
        "asked": settings["options"]["trials"],
        "searcher": settings["options"]["searcher"],
        "trials": [
            {
                "number": trial.number,
                "status": trial.status,
                "step": trial.step,
                "score": trial.score,
                "deaths": trial.deaths,
                "reason": trial.reason,
                "unpruned": trial.number < spared,
                "point": trial.point,
                "scores": {str(step): trial.scores[step] for step in sorted(trial.scores)},
                "parts": {str(step): trial.parts[step] for step in sorted(trial.parts)},
            }
            for trial in trials
        ],
        "best": None if best is None else trials.index(best),
        "gain": None
        if best is None or whole[0].number != 0
        else best.scores[budgets[-1]] - whole[0].scores[budgets[-1]],
        "rank_correlation": correlations,
        "shown": correlations["unpruned" if fair else "all"],
        "shown_of": "unpruned" if fair else "all",
    }


def markdown(document: Document) -> str:
    """The report for people."""
    budgets, trials = document["budgets"], document["trials"]
    names = [*document["axes"], "power"]
    parts = [part for part in _HEADINGS if any(part in _last(trial) for trial in trials)]
    lines = [
        f"{len(trials)} of {document['asked']} trials begun ({document['searcher']}): "
        + ", ".join(
            f"{sum(trial['status'] == status for trial in trials)} {status}"
            for status in ("finished", "stopped", "diverged", "failed", "running")
            if any(trial["status"] == status for trial in trials)
        ),
        "",
        f"{_searched(document)}.",
        "",
    ]
    if document["best"] is not None:
        best = trials[document["best"]]
        line = f"Best of those that ran to the end: trial {best['number']}, {best['scores'][str(budgets[-1])]:.2f} dB"
        if best["number"] == 0:
            line += ", the preset's own values"
        elif document["gain"] is not None:
            line += f", {document['gain']:+.2f} dB against trial 0, which has the preset's values"
        lines += [f"{line}.", ""]
        if best["number"] != 0 and document["gain"] is not None:
            lines += _motion(best, trials[0], str(budgets[-1]))
        if document["shared"]:
            given = ", ".join(f"{name} {json.dumps(value)}" for name, value in document["shared"].items())
            lines += [f"`best.json` also has what --config gave all trials, for a run of their kind: {given}.", ""]
    lines += _table(
        [
            *("trial", "status", *(f"at {budget}" for budget in budgets)),
            *(_HEADINGS[part] for part in parts),
            *(name.replace("_", " ") for name in names),
        ],
        [
            [
                f"{t['number']}{'*' if t['unpruned'] else ''}",
                t["status"],
                *(_rounded(t["scores"].get(str(budget))) for budget in budgets),
                *(_rounded(_last(t).get(part)) for part in parts),
                *(f"{t['point'][name]:.3g}" if name in t["point"] else "" for name in names),
            ]
            for t in sorted(trials, key=lambda t: (-t["step"], -(t["score"] or 0)))
        ],
    )
    lines += ["", "Scores in dB, after so many steps. * runs to the end whatever its scores."]
    if parts:
        lines[-1] += " RGB, depth, flow and TCP are those of a trial's last score."
    for of, which in (("all", "all trials"), ("unpruned", "the unpruned trials")):
        pairs = document["rank_correlation"][of]
        if any(pair["r"] is not None for pair in pairs):
            lines += ["", f"Spearman rank correlation between budgets, {which}:", ""]
            lines += _table(
                ["budgets", "r", "p", "n"],
                [[" and ".join(map(str, pair["budgets"])), *_correlation(pair), str(pair["n"])] for pair in pairs],
            )
    return "\n".join(lines) + "\n"


def _motion(best: Document, default: Document, budget: str) -> list[str]:
    """What the score does not see: a model may gain in PSNR and lose the motion that a planner goes by."""
    ours, theirs = (trial["parts"].get(budget, {}) for trial in (best, default))
    known = [name for name in _MOTION if name in ours and name in theirs]
    if not known:
        return []
    told = "; ".join(f"{_MOTION[name]} {ours[name]:.2f} (trial 0: {theirs[name]:.2f})" for name in known)
    worse = any(ours[name] > WORSE * theirs[name] for name in known)
    return [f"Which no score counts: {told}{': plan with it before you believe it' if worse else ''}.", ""]


def _last(trial: Document) -> dict[str, float]:
    """The parts of a trial's last score."""
    parts: dict[str, dict[str, float]] = trial["parts"]
    return parts.get(str(trial["step"]), {})


def _searched(document: Document) -> str:
    """The ranges, and what they are about."""
    of = "" if document["around"] is None else f" within a factor of {document['around']:g} of the preset's values"
    ranges = [f"{name.replace('_', ' ')} {low:.2g} to {high:.2g}" for name, (low, high) in document["axes"].items()]
    return f"Searched{of}: {', '.join(ranges)}, power 1 or 2"


def _table(head: list[str], rows: list[list[str]]) -> list[str]:
    return [f"| {' | '.join(row)} |" for row in [head, ["---"] * len(head), *rows]]


def _rounded(value: float | None) -> str:
    return "" if value is None else f"{value:.2f}"


def _correlation(pair: dict[str, Any]) -> list[str]:
    """r and p, empty where there is none."""
    return ["", ""] if pair["r"] is None else [f"{pair['r']:.3f}", written(pair["p"])]
