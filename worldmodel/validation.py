"""How good a model is on clips that it was not trained on, beside copying the last frame it saw: while it trains."""

from __future__ import annotations

import math
from statistics import fmean
from typing import Any

import numpy as np

from worldmodel.held_out import ValidationSet
from worldmodel.measurement import measure_model
from worldmodel.scores import Statistics, score_clips
from worldmodel.t3vip import T3VIP
from worldmodel.world_model import WorldModel

Scores = dict[str, float | list[float]]
_MEANS = {
    "inpainted": "inpainted",
    "flow_error_moving": "flow3d_epe_moving_relative",
    "flow_error_hand": "flow3d_epe_hand_relative",
    "false_flow_m": "false_flow_m",
    "tracking_error": "tracking_error",
}
"""What they are called here, and in `scores.SCORES`."""


def validate(model: WorldModel, data: ValidationSet) -> Scores:
    """Score free-running prediction with latents at 0, and motion where the dataset knows it.

    Args:
        model: any world model; left in the mode it was in.
        data: the held-out clips.

    Returns:
        Per predicted step after the context: `psnr`, `copy_psnr` (dB), and of T3VIP `depth_rmse`, `copy_depth_rmse`
        (metres) and `depth_psnr` (dB; its peak is the camera's working range, far less near). Means: `score` (RGB PSNR,
        of T3VIP plus depth PSNR, in dB: the paper's tuning metric); of T3VIP `inpainted` (share of pixels) and, with
        ground truth, one step ahead of true frames, `flow_error_moving` and `flow_error_hand` (relative to predicting
        no motion) and `false_flow_m` (mean length predicted on still pixels); of an arm `tracking_error`: how far the
        moved TCP is off at the end of the clip, over how far it really went. A term that nothing moves for is left out.
    """
    was_training = model.training
    kinds = measure_model(model.eval(), data, brief=True).kinds
    model.train(was_training)
    ours, copied = _scored(kinds["zero"]), _scored(kinds["copy"])
    psnr = _curve(ours, "psnr")
    scores: Scores = {"psnr": psnr, "copy_psnr": _curve(copied, "psnr"), "score": fmean(psnr)}
    if not isinstance(model, T3VIP):
        return scores
    rmse, span = _curve(ours, "depth_rmse"), model.camera.far - model.camera.near
    depth_psnr = [20 * math.log10(span / max(error, 1e-9)) for error in rmse]
    scores |= {"depth_rmse": rmse, "copy_depth_rmse": _curve(copied, "depth_rmse"), "depth_psnr": depth_psnr}
    scores["score"] = fmean(psnr) + fmean(depth_psnr)
    return scores | {name: ours[theirs] for name, theirs in _MEANS.items() if ours[theirs] is not None}


def _scored(statistics: Statistics) -> dict[str, Any]:
    """Without intervals, as of one episode."""
    return score_clips(statistics, np.zeros(len(statistics["se"]), np.int64))


def _curve(scored: dict[str, Any], name: str) -> list[float]:
    """One value per predicted step; NaN where it is no number."""
    return [math.nan if value is None else value for value in scored["curves"][name]]


def summary(scores: Scores) -> str:
    """One line for people: gains over copying at the first and last step, and the motion scores."""
    psnr, copy = _steps(scores["psnr"]), _steps(scores["copy_psnr"])
    line = f"PSNR {psnr[0]:.1f} ({psnr[0] - copy[0]:+.1f}) to {psnr[-1]:.1f} ({psnr[-1] - copy[-1]:+.1f} dB over copy)"
    if "depth_rmse" in scores:
        ours, copied = _steps(scores["depth_rmse"])[-1], _steps(scores["copy_depth_rmse"])[-1]
        line += f", depth RMSE {ours / copied:.2f} of copying's" if copied > 0 else f", depth RMSE {ours:.3f} m"
        line += f", inpainted {100 * float(scores['inpainted']):.1f} %"  # type: ignore[arg-type]
    if "flow_error_moving" in scores:
        line += f", flow error {scores['flow_error_moving']:.2f}"
    if "flow_error_hand" in scores:
        line += f" (hand {scores['flow_error_hand']:.2f})"
    if "false_flow_m" in scores:
        line += f", false flow {1000 * float(scores['false_flow_m']):.2f} mm"  # type: ignore[arg-type]
    if "tracking_error" in scores:
        line += f", tracking error {scores['tracking_error']:.2f}"
    return line


def _steps(values: float | list[float]) -> list[float]:
    assert isinstance(values, list)
    return values
