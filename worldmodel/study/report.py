"""study.md: the paper's table with ours beside it."""

from __future__ import annotations

import json
from collections.abc import Callable, Sequence
from typing import Any

from worldmodel.evaluation_report import ARROWS
from worldmodel.scores import SCORES, Score
from worldmodel.study.findings import findings
from worldmodel.study.paper import METRICS

_SCORES = {score.name: score for score in SCORES}
_COLUMNS = [_SCORES[name] for name in METRICS]
_MOTION = (
    "flow3d_epe_moving_relative",
    "flow3d_epe_hand_relative",
    "false_flow_m",
    "disocclusion_f1",
    "motion_ari",
    "body_ari",
    "tracking_error",
)
_PICTURES = ("curves.png", "bars.png")

Document = dict[str, Any]
Row = tuple[str, Sequence[str]]


def markdown(document: Document) -> str:
    """The whole report, from study.json."""
    lines = [f"# {document['title']}", "", document["question"], "", *_protocol(document), ""]
    if document["missing"]:
        lines += [f"Not there yet: {', '.join(document['missing'])}.", ""]
    if not document["models"]:
        return "\n".join(lines)
    lines += ["## What it says", "", *(f"- {sentence}" for sentence in findings(document)), ""]
    for gap in sorted(int(gap) for gap in document["copy"]):
        for horizon in reversed(document["settings"]["horizons"]):
            lines += _compared(document, gap, str(horizon))
    lines += _motion(document)
    lines += _training(document)
    lines += ["## Pictures", "", *(f"![{name}]({name})" for name in _PICTURES), ""]
    return "\n".join(lines)


def _protocol(document: Document) -> list[str]:
    data, settings, budget = document["data"], document["settings"], document["budget"]
    each = f"{budget['minutes']:g} minutes" if "minutes" in budget else f"{budget['steps']} steps"
    changed = f" with {json.dumps(settings['config'])}" if settings["config"] else ""
    samples = "latents at 0"
    if settings["samples"]:
        chosen = _chosen(document) or f"best of {settings['samples']} by {settings['select'].upper()}"
        samples = f"{chosen} over all frames for models with latents, one future for those without"
    machines = _machines(document)
    place = f", on {machines}" if machines else ""
    return [
        f"**Ours**: trained on {data['train']['env_id']} ({data['train']['episodes']} episodes) for {each} each, one "
        f"after the other{place}, preset `{settings['preset']}`{changed}, seed {settings['seed']}; the best model on "
        f"{data['validation']['env_id']} ({data['validation']['episodes']} other episodes) is tested on "
        f"{data['test']['env_id']} ({data['test']['episodes']} episodes, {settings['clips']} clips). "
        f"{settings['context']} frames seen, {settings['horizons'][-1]} predicted, free running; {samples}. Shorter "
        "horizons are the first frames of the same predictions. VGG is 1 - LPIPS.",
        "",
        "**The paper's** numbers stand beside ours for orders and gaps between models. They are of other data, 200,000 "
        "steps on a GPU, and best of 100 samples: absolute values do not compare.",
    ]


def _chosen(document: Document) -> str:
    """How the best of many futures was chosen, by the evaluations: VGG may have been missing from some."""
    models = document["models"].items()
    return _by_run({run: model["prediction"] for run, model in models if model["latents_zero"] is not None})


def _machines(document: Document) -> str:
    """What the models were trained on, by the runs, of which older ones do not say."""
    machines = {run: model["training"]["machine"] for run, model in document["models"].items()}
    return _by_run(
        {
            run: f"{m['gpu'] or m['cpu']} ({m['cores']} cores)" if m else "an unknown machine"
            for run, m in machines.items()
        }
    )


def _by_run(values: dict[str, str]) -> str:
    """The value; where there are several, each with its runs."""
    runs: dict[str, list[str]] = {}
    for run, value in values.items():
        runs.setdefault(value, []).append(run)
    several = (f"{value} for {', '.join(of)}" for value, of in runs.items())
    return " and ".join(several if len(runs) > 1 else runs)


def _compared(document: Document, gap: int, horizon: str) -> list[str]:
    """One table: the models at a frame gap over a horizon, the paper's columns beside ours where it has such."""
    models = [m for m in document["models"].values() if m["frame_gap"] == gap]
    setting = document["paper"][str(gap)]
    beside = setting is not None and horizon == str(document["settings"]["horizons"][-1])
    ours = f"ours, {_environment(document)}"
    head = [f"{_short(s)} {ARROWS[s.better]}, {ours}" for s in _COLUMNS]
    title = f"## Frame gap {gap}, {horizon} frames ahead"
    note: list[str] = []
    if beside:
        head += [f"{_short(s)} {ARROWS[s.better]}, paper, {setting['dataset']}" for s in _COLUMNS]
        steps = setting["test_steps"]
        note = [f"Paper: {setting['table']}, {setting['dataset']}, skip = {setting['skip']}, {steps} frames.", ""]
    scores = [m["horizons"][horizon] for m in models]
    published = [m["paper"] or dict.fromkeys(METRICS) for m in models]
    rows: list[Row] = []
    for model, values, paper in zip(models, scores, published, strict=True):
        cells = [_best(values[s.name], [v[s.name] for v in scores], s) for s in _COLUMNS]
        if beside:
            cells += [_best(paper[s.name], [p[s.name] for p in published], s) for s in _COLUMNS]
        rows.append((model["title"], cells))
        if model["latents_zero"] is not None:
            zero = model["latents_zero"][horizon]
            rows.append(
                (f"{model['title']}, latents at 0", [_cell(zero[s.name], s) for s in _COLUMNS] + [""] * 5 * beside)
            )
    copied = document["copy"][str(gap)]["horizons"][horizon]
    rows.append(("last frame copied", [_cell(copied[s.name], s) for s in _COLUMNS] + [""] * 5 * beside))
    return [title, "", *note, *_table(head, rows), ""]


def _motion(document: Document) -> list[str]:
    """What the simulator says about the motion of models that have one."""
    models = [m for m in document["models"].values() if any(m["motion"].get(name) is not None for name in _MOTION)]
    if not models:
        return []
    shown = [_SCORES[name] for name in _MOTION if any(m["motion"].get(name) is not None for m in models)]
    rows = [
        (f"{m['title']}, gap {m['frame_gap']}", [_cell(m["motion"].get(score.name), score) for score in shown])
        for m in models
    ]
    head = [f"{score.title} {ARROWS[score.better]}" for score in shown]
    note = "Against the simulator, one step ahead of true frames, latents at 0. Relative: 1 is predicting no motion."
    return ["## Motion", "", note, "", *_table(head, rows), ""]


def _training(document: Document) -> list[str]:
    head = ["steps done", "minutes", "best step", "parameters", "prediction scored"]
    rows = []
    for model in document["models"].values():
        training = model["training"]
        cells = [f"{training['steps']:,}", f"{training['minutes']:.1f}", f"{training['best_step']:,}"]
        cells += [f"{training['parameters'] / 1e6:.2f} M", model["prediction"]]
        rows.append((f"{model['title']}, gap {model['frame_gap']}", cells))
    commands = [model["command"] for model in document["models"].values()]
    return ["## Training", "", *_table(head, rows), "", "```sh", *commands, "```", ""]


def _environment(document: Document) -> str:
    """`Tabletop` of `t3vip/TabletopD-v0`."""
    name = str(document["data"]["test"]["env_id"]).rsplit("/", 1)[-1].split("-v")[0]
    return "Tabletop" if name.startswith("Tabletop") else name


def _short(score: Score) -> str:
    """`VGG` of `VGG (1 - LPIPS)`."""
    return score.title.split(" (")[0]


def _best(value: float | None, others: Sequence[float | None], score: Score) -> str:
    """A cell, bold if it is the best of its column."""
    known = [other for other in others if other is not None]
    choose: Callable[[Sequence[float]], float] = max if score.better == "higher" else min
    text = _cell(value, score)
    return f"**{text}**" if value is not None and len(known) > 1 and value == choose(known) else text


def _cell(value: float | None, score: Score) -> str:
    return "–" if value is None else f"{value:.{score.digits}f}"


def _table(head: Sequence[str], rows: Sequence[Row]) -> list[str]:
    lines = ["| | " + " | ".join(head) + " |", "|---" * (len(head) + 1) + "|"]
    return lines + ["| " + " | ".join([title, *cells]) + " |" for title, cells in rows]
