"""How good a model is on clips that it was not trained on, beside copying the last frame it saw."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from math import isfinite

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from worldmodel.clips import Clips, ClipSource
from worldmodel.metrics import flow_scores, psnr_per_step, rmse_per_step
from worldmodel.rollout import Rollout, unroll
from worldmodel.t3vip import T3VIP, CloudPrediction
from worldmodel.tracking import tcp_way
from worldmodel.world_model import WorldModel

Scores = dict[str, float | list[float]]
MIN_WAY_M = 0.03
"""Clips in which the hand goes less than this far do not count for the tracking error."""


@dataclass(frozen=True)
class ValidationSet:
    """A fixed set of held-out clips.

    Args:
        source: where they come from.
        clips: how many, spread evenly over the data.
        frames: of each clip, context included.
        context: how many frames the model sees.
    """

    source: ClipSource
    clips: int = 64
    frames: int = 12
    context: int = 2
    batch: int = 16

    def batches(self) -> Iterator[tuple[Clips, NDArray[np.int64]]]:
        """The clips in batches, with their first rows."""
        starts = self.source.spread(self.clips, self.frames)
        for first in range(0, len(starts), self.batch):
            chosen = starts[first : first + self.batch]
            yield self.source.at(chosen, self.frames), chosen


@torch.inference_mode()
def validate(model: WorldModel, data: ValidationSet, still: bool = False) -> Scores:
    """Score free-running prediction with latents at 0, and motion where the dataset knows it.

    Args:
        model: any world model; left in the mode it was in.
        data: the held-out clips.
        still: pretend that every transform is the identity; the scores must then be those of copying.

    Returns:
        Per predicted step after the context: `psnr`, `copy_psnr` (dB), and of T3VIP `depth_rmse`, `copy_depth_rmse`
        (metres) and `depth_psnr` (dB; its peak is the camera's working range, far less near). Means: `score` (RGB PSNR,
        of T3VIP plus depth PSNR, in dB: the paper's tuning metric); of T3VIP `inpainted` (share of pixels) and, with
        ground truth, the terms of `flow_scores`, one step ahead of true frames; of an arm `tracking_error`: how far
        the moved TCP is off at the end of the clip, over how far it really went. A term that nothing moves for is
        left out.
    """
    was_training = model.training
    model.eval()
    device = model.device
    predicted_rgb, predicted_depth, rgb, depth, inpainted = [], [], [], [], []
    flows: list[tuple[Tensor, Tensor, Tensor]] = []
    tracked: list[tuple[Tensor, Tensor]] = []
    c = data.context
    for clips, starts in data.batches():
        clips = clips.to(device)
        free = unroll(model, clips, c, still=still)
        predicted_rgb.append(free.stack("rgb")[:, c - 1 :].cpu())
        rgb.append(clips.rgb[:, c - 1 :].cpu())
        if not isinstance(model, T3VIP):
            continue
        predicted_depth.append(free.stack("depth")[:, c - 1 :].cpu())
        depth.append(clips.depth[:, c - 1 :].cpu())
        inpainted.append(free.stack("occlusion")[:, c - 1 :].mean((1, 2, 3, 4)).cpu())
        if data.source.dataset.has_ground_truth:
            truth = data.source.truth_at(starts, data.frames)
            taught = unroll(model, clips, c, truth=1.0, still=still)
            flow = taught.stack("scene_flow")[:, c - 1 :].cpu()
            flows.append((flow, truth.scene_flow[:, c - 1 :], truth.hand[:, c - 1 :]))
            if truth.tcp is not None:
                tracked.append(track_tcp(model, clips, truth.tcp, free, c))
    model.train(was_training)
    all_rgb = torch.cat(rgb)
    psnr = psnr_per_step(torch.cat(predicted_rgb), all_rgb[:, 1:])
    scores: Scores = {
        "psnr": psnr.tolist(),
        "copy_psnr": psnr_per_step(all_rgb[:, :1].expand_as(all_rgb[:, 1:]), all_rgb[:, 1:]).tolist(),
        "score": float(psnr.mean()),
    }
    if not isinstance(model, T3VIP):
        return scores
    all_depth, camera = torch.cat(depth), model.camera
    depth_rmse = rmse_per_step(torch.cat(predicted_depth), all_depth[:, 1:])
    depth_psnr = 20 * torch.log10((camera.far - camera.near) / depth_rmse.clamp(min=1e-9))
    scores |= {
        "depth_rmse": depth_rmse.tolist(),
        "copy_depth_rmse": rmse_per_step(all_depth[:, :1].expand_as(all_depth[:, 1:]), all_depth[:, 1:]).tolist(),
        "depth_psnr": depth_psnr.tolist(),
        "inpainted": float(torch.cat(inpainted).mean()),
        "score": float(psnr.mean() + depth_psnr.mean()),
    }
    if flows:
        predicted, true, hand = (torch.cat(parts) for parts in zip(*flows, strict=True))
        scores.update({name: value for name, value in flow_scores(predicted, true, hand).items() if isfinite(value)})
    if tracked:
        error, way = (torch.cat(parts) for parts in zip(*tracked, strict=True))
        counts = way > MIN_WAY_M
        if counts.any():
            scores["tracking_error"] = float(error[counts].mean() / way[counts].mean())
    return scores


def track_tcp(model: T3VIP, clips: Clips, tcp: Tensor, free: Rollout, context: int) -> tuple[Tensor, Tensor]:
    """How far the TCP, moved by predicted transforms, is off at the clip's end, and how far it went, (B,) metres."""
    points = clips.depth[:, context - 1] * model.rays
    clouds = [p for p in free.predictions[context - 1 :] if isinstance(p, CloudPrediction)]
    ends = []
    for b in range(len(points)):
        steps = ((cloud.transform[b : b + 1], cloud.masks[b : b + 1, :1]) for cloud in clouds)
        ends.append(tcp_way(points[b], tcp[b, context - 1].to(points), model.intrinsics, steps)[-1].cpu())
    error = (torch.stack(ends) - tcp[:, -1]).norm(dim=1)
    return error, (tcp[:, -1] - tcp[:, context - 1]).norm(dim=1)


def summary(scores: Scores) -> str:
    """One line for people: gains over copying at the first and last step, and the motion scores."""
    psnr, copy = _steps(scores["psnr"]), _steps(scores["copy_psnr"])
    line = f"PSNR {psnr[0]:.1f} ({psnr[0] - copy[0]:+.1f}) to {psnr[-1]:.1f} ({psnr[-1] - copy[-1]:+.1f} dB over copy)"
    if "depth_rmse" in scores:
        share = _steps(scores["depth_rmse"])[-1] / _steps(scores["copy_depth_rmse"])[-1]
        line += f", depth RMSE {share:.2f} of copying's, inpainted {100 * float(scores['inpainted']):.1f} %"  # type: ignore[arg-type]
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
