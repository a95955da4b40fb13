"""What a study's numbers say, in sentences that are made from them: also where they are not what one hoped for."""

from __future__ import annotations

from typing import Any

from worldmodel.scores import SCORES

PICTURE = ("psnr", "ssim", "vgg")
_BETTER = {score.name: 1 if score.better == "higher" else -1 for score in SCORES}
_TITLE = {"psnr": "PSNR", "ssim": "SSIM", "vgg": "VGG", "depth_rmse": "depth RMSE", "depth_absrel": "depth AbsRel"}
FOUND_MOTION = 0.5
"""Scene-flow error on moving pixels, relative to predicting none, below which a model has found the motion."""

Document = dict[str, Any]


def findings(document: Document) -> list[str]:
    """Sentences, the study's own first; every study asks whether its models are ahead of copying the last frame."""
    own = {"table": _against_rivals, "ablation": _terms, "action-free": _latents}[document["study"]]
    return own(document) + _against_copy(document)


def _against_rivals(document: Document) -> list[str]:
    """Where T3VIP is ahead of each rival, and where not: as scored, and with one prediction for every model."""
    if not any(model.get("latents_zero") for model in document["models"].values()):
        return _standing(document, "")
    single = {run: m | {"horizons": m["latents_zero"] or m["horizons"]} for run, m in document["models"].items()}
    return _standing(document, "") + _standing(document | {"models": single}, "With latents at 0, ")


def _standing(document: Document, how: str) -> list[str]:
    ahead, behind = 0, []
    for gap, models in _by_gap(document).items():
        for rival in (m for m in models if m["name"] != "t3vip"):
            for horizon, metric, ours, theirs in _compare(_named(models, "t3vip"), rival):
                if _gain(metric, ours, theirs) > 0:
                    ahead += 1
                else:
                    behind.append(
                        f"{rival['title']} in {_TITLE[metric]} at gap {gap}, {horizon} frames "
                        f"({theirs:.3f} against {ours:.3f})"
                    )
    if not ahead and not behind:
        return []
    sentence = (
        f"{how}T3VIP is ahead of its rivals in {ahead} of {ahead + len(behind)} comparisons (PSNR, SSIM and VGG, each "
        "rival, gap and horizon)"
    )
    return [sentence + (f"; not ahead of {'; '.join(behind)}." if behind else ".")]


def _terms(document: Document) -> list[str]:
    """The order of M1 to M6, the paper's and ours, and which of them found the motion."""
    lines = []
    last = str(document["settings"]["horizons"][-1])
    for gap, models in _by_gap(document).items():
        scored = {m["name"]: m["horizons"][last]["psnr"] for m in models}
        ours = " < ".join(sorted(scored, key=lambda name: scored[name]))
        lines.append(f"By PSNR over {last} frames at gap {gap}: {ours}; in the paper M3 < M4 < M5 < M6.")
        flow = {m["name"]: m["motion"].get("flow3d_epe_moving_relative") for m in models}
        if all(value is not None for value in flow.values()):
            found = [name for name, value in flow.items() if value < FOUND_MOTION]
            lost = [name for name in flow if name not in found]
            lines.append(
                f"Found the motion (scene-flow error on moving pixels below {FOUND_MOTION} of predicting none): "
                f"{', '.join(found) or 'none'}; did not: {', '.join(lost) or 'none'}. In the paper M1 and M2 did not."
            )
    return lines


def _latents(document: Document) -> list[str]:
    """Whether latents help, and 3D does, without actions."""
    lines = []
    last = str(document["settings"]["horizons"][-1])
    for gap, models in _by_gap(document).items():
        full = _named(models, "t3vip")
        for other in (m for m in models if m["name"] != "t3vip"):
            gains = [
                f"{_TITLE[metric]} {ours - theirs:+.3f}"
                for horizon, metric, ours, theirs in _compare(full, other)
                if horizon == last
            ]
            if gains:
                lines.append(f"T3VIP against {other['title']}, {last} frames at gap {gap}: {', '.join(gains)}.")
    if lines:
        lines.append("In the paper's figure T3VIP is ahead of T3VIP-D and of SV2P.")
    return lines


def _against_copy(document: Document) -> list[str]:
    """Who is not ahead of copying the last frame seen; the paper does not report it."""
    behind = []
    for gap, models in _by_gap(document).items():
        copied = document["copy"][str(gap)]
        for model in models:
            for horizon, metric, ours, theirs in _compare(model, copied, (*PICTURE, "depth_rmse", "depth_absrel")):
                if _gain(metric, ours, theirs) <= 0:
                    behind.append(
                        f"{model['title']} in {_TITLE[metric]} at gap {gap}, {horizon} frames "
                        f"({ours:.3f} against {theirs:.3f})"
                    )
    if not document["models"]:
        return []
    if not behind:
        return ["Every model is ahead of copying the last frame, in every score, gap and horizon."]
    return [f"Not ahead of copying the last frame: {'; '.join(behind)}."]


def _compare(
    ours: Document | None, theirs: Document, metrics: tuple[str, ...] = PICTURE
) -> list[tuple[str, str, float, float]]:
    """(horizon, metric, ours, theirs) of all that both have."""
    if ours is None:
        return []
    return [
        (horizon, metric, values[metric], theirs["horizons"][horizon][metric])
        for horizon, values in ours["horizons"].items()
        for metric in metrics
        if values[metric] is not None and theirs["horizons"][horizon][metric] is not None
    ]


def _gain(metric: str, ours: float, theirs: float) -> float:
    return _BETTER[metric] * (ours - theirs)


def _by_gap(document: Document) -> dict[int, list[Document]]:
    gaps: dict[int, list[Document]] = {}
    for model in document["models"].values():
        gaps.setdefault(model["frame_gap"], []).append(model)
    return dict(sorted(gaps.items()))


def _named(models: list[Document], name: str) -> Document | None:
    return next((model for model in models if model["name"] == name), None)
