"""What is measured of a model, or of copying the last frame, on every clip of a held-out set."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from worldmodel.clips import Clips, ClipTruth
from worldmodel.held_out import ValidationSet
from worldmodel.inference import InferenceNetwork
from worldmodel.latents import infer_latents, latent_use
from worldmodel.metrics import relative_depth_error, squared_error, ssim
from worldmodel.motion_scores import flow_statistics, motion_statistics, no_motion, predicted_motion, true_motion
from worldmodel.perceptual import PerceptualNetwork
from worldmodel.rollout import Rollout, unroll
from worldmodel.sampling import Selection, best_future, draw_latents, predict_futures
from worldmodel.scores import Statistics, join
from worldmodel.shelf import NOTHING_KEPT, Shelf
from worldmodel.t3vip import T3VIP, CloudPrediction
from worldmodel.tracking import tcp_way
from worldmodel.world_model import WorldModel

Tick = Callable[[int], Any]
"""Told how many more clips are done."""
MIN_WAY_M = 0.03
"""Clips in which the hand goes less than this far do not count for the tracking error."""
_LATENTS = "latents"


@dataclass(frozen=True)
class Networks:
    """What judges pictures like VGG; see `sampling.best_future`."""

    ranking: PerceptualNetwork
    deciding: PerceptualNetwork


@dataclass(frozen=True)
class Sampling:
    """How the best of many futures is found.

    Args:
        samples: N, for each clip.
        select: what it is the best in, all predicted frames taken together.
        seed: of the latents.
    """

    samples: int
    select: Selection
    seed: int = 0


@dataclass
class Measured:
    """Statistics of all clips by kind of prediction: `zero`, `best`, `still`, `posterior`, `copy`; the latents' use."""

    kinds: dict[str, Statistics]
    latents: dict[str, Any] | None = None

    @property
    def headline(self) -> Statistics:
        """Of the best of many where there are many; motion is that of latents at 0 in any case."""
        return {**self.kinds["zero"], **self.kinds.get("best", {})}


@torch.inference_mode()
def measure_copy(data: ValidationSet, networks: Networks | None, tick: Tick, shelf: Shelf = NOTHING_KEPT) -> Statistics:
    """Copying the last context frame, in colour and depth; nothing moves."""
    parts = []
    for number, (clips, starts) in enumerate(data.batches()):
        found = shelf.find(number)
        parts.append(found or shelf.put(number, _copied(data, clips, starts, networks)))
        tick(len(starts))
    return join(parts)


def _copied(data: ValidationSet, clips: Clips, starts: NDArray[np.int64], networks: Networks | None) -> Statistics:
    c, statistics = data.context, _frames_copied(clips, data.context, networks)
    statistics["inpainted"] = torch.zeros_like(statistics["se"])
    if data.source.dataset.has_ground_truth:
        truth = data.source.truth_at(starts, data.frames)
        moved = true_motion(data.source.dataset.camera, clips, truth, c)
        statistics |= motion_statistics(no_motion(moved), moved, truth.hand[:, c - 1 :])
        if truth.tcp is not None:
            way = (truth.tcp[:, -1] - truth.tcp[:, c - 1]).norm(dim=1)
            statistics |= _tracking(way, way)
    return statistics


@torch.inference_mode()
def measure_model(
    model: WorldModel,
    data: ValidationSet,
    networks: Networks | None = None,
    sampling: Sampling | None = None,
    inference: InferenceNetwork | None = None,
    still: bool = False,
    tick: Tick = lambda clips: None,
    shelf: Shelf = NOTHING_KEPT,
    brief: bool = False,
) -> Measured:
    """Free-running prediction after the context, and motion one step ahead of true frames.

    Args:
        model: in evaluation mode.
        data: the clips.
        networks: for the VGG scores.
        sampling: find the best of many futures of a model with latents; with None there is no kind `best`.
        inference: of the model, for the kind `posterior`: latents at the mean of q(z | clip).
        still: measure the kind `still` too: the same model with every transform the identity, or every kernel a copy.
        tick: told of progress.
        shelf: where batches that were measured are kept and looked for; by default nowhere.
        brief: measure what is quickly measured: errors of colour, depth, scene flow and tracking; and the kind `copy`.
    """
    parts = []
    for number, (clips, starts) in enumerate(data.batches()):
        found = shelf.find(number)
        if found is None:
            measured = _predicted(model, data, clips, starts, networks, sampling, inference, still, tick, brief)
            found = shelf.put(number, {f"{k}/{n}": value for k, some in measured.items() for n, value in some.items()})
        else:
            tick(len(starts))
        parts.append(found)
    kinds: dict[str, Statistics] = defaultdict(dict)
    for name, values in join(parts).items():
        kind, _, statistic = name.partition("/")
        kinds[kind][statistic] = values
    inferred = kinds.pop(_LATENTS, None)
    return Measured(dict(kinds), latent_use(inferred) if inferred is not None else None)


def _predicted(
    model: WorldModel,
    data: ValidationSet,
    clips: Clips,
    starts: NDArray[np.int64],
    networks: Networks | None,
    sampling: Sampling | None,
    inference: InferenceNetwork | None,
    still: bool,
    tick: Tick,
    brief: bool,
) -> dict[str, Statistics]:
    """One batch of `measure_model`, by kind of prediction; and what its latents carry."""
    clips, c = clips.to(model.device), data.context
    truth = data.source.truth_at(starts, data.frames) if data.source.dataset.has_ground_truth else None
    kinds: dict[str, Statistics] = {}
    for kind in ["zero"] + ["still"] * still:
        free = unroll(model, clips, c, still=kind == "still")
        kinds[kind] = _free(model, free, clips, c, networks, brief)
        if isinstance(model, T3VIP) and truth is not None:
            if truth.tcp is not None:
                kinds[kind] |= _tracking(*_track_tcp(model, clips, truth.tcp, free, c))
            kinds[kind] |= _taught(model, data, clips, truth, kind == "still", brief)
    if brief:
        kinds["copy"] = _frames_copied(clips, c, networks, brief)
    if inference is not None:
        mean, kinds[_LATENTS] = infer_latents(model, inference, clips)
        kinds["posterior"] = _free(model, unroll(model, clips, c, mean), clips, c, networks)
    if sampling is None or not model.latent_channels:
        tick(len(starts))
        return kinds
    best = []
    for b, start in enumerate(starts.tolist()):
        clip = Clips(clips.rgb[b : b + 1], clips.depth[b : b + 1], clips.actions[b : b + 1])
        best.append(measure_best(model, clip, start, c, networks, sampling))
        tick(1)
    kinds["best"] = join(best)
    return kinds


def _frames(
    rgb: Tensor, depth: Tensor | None, clips: Clips, context: int, networks: Networks | None, brief: bool = False
) -> Statistics:
    """Of predicted frames (B, P, C, H, W), (B, P) each."""
    rgb, true = rgb.clamp(0, 1), clips.rgb[:, context:]
    shape, flat, flat_true = rgb.shape[:2], rgb.flatten(0, 1), true.flatten(0, 1)
    statistics = {"se": squared_error(rgb, true)}
    if not brief:
        statistics["ssim"] = ssim(flat, flat_true).view(shape)
    if networks is not None:
        lpips, cosine = networks.deciding(flat, flat_true)
        statistics |= {"lpips": lpips.view(shape), "cosine": cosine.view(shape)}
    if depth is not None:
        true_depth = clips.depth[:, context:]
        statistics["depth_se"] = squared_error(depth, true_depth)
        if not brief:
            statistics["depth_absrel"] = relative_depth_error(depth, true_depth)
    return statistics


def _frames_copied(clips: Clips, context: int, networks: Networks | None, brief: bool = False) -> Statistics:
    """The last context frame in the place of those after it."""
    rgb, depth = (seen[:, context - 1 : context].expand_as(seen[:, context:]) for seen in (clips.rgb, clips.depth))
    return _frames(rgb, depth, clips, context, networks, brief)


def _free(
    model: WorldModel, free: Rollout, clips: Clips, context: int, networks: Networks | None, brief: bool = False
) -> Statistics:
    rgb = free.stack("rgb")[:, context - 1 :]
    if not isinstance(model, T3VIP):
        return _frames(rgb, None, clips, context, networks, brief)
    statistics = _frames(rgb, free.stack("depth")[:, context - 1 :], clips, context, networks, brief)
    return statistics | {"inpainted": free.stack("occlusion")[:, context - 1 :].mean((2, 3, 4))}


def _taught(model: T3VIP, data: ValidationSet, clips: Clips, truth: ClipTruth, still: bool, brief: bool) -> Statistics:
    c = data.context
    taught, hand = unroll(model, clips, c, truth=1.0, still=still), truth.hand[:, c - 1 :]
    if brief:
        flow = taught.stack("scene_flow")[:, c - 1 :].cpu()
        return flow_statistics(flow, truth.scene_flow[:, c - 1 :], hand)
    return motion_statistics(
        predicted_motion(taught, c), true_motion(data.source.dataset.camera, clips, truth, c), hand
    )


def _track_tcp(model: T3VIP, clips: Clips, tcp: Tensor, free: Rollout, context: int) -> tuple[Tensor, Tensor]:
    """How far the TCP, moved by predicted transforms, is off at the clip's end, and how far it went, (B,) metres."""
    points = clips.depth[:, context - 1] * model.rays
    clouds = [p for p in free.predictions[context - 1 :] if isinstance(p, CloudPrediction)]
    ends = []
    for b in range(len(points)):
        steps = ((cloud.transform[b : b + 1], cloud.masks[b : b + 1, :1]) for cloud in clouds)
        ends.append(tcp_way(points[b], tcp[b, context - 1].to(points), model.intrinsics, steps)[-1].cpu())
    error = (torch.stack(ends) - tcp[:, -1]).norm(dim=1)
    return error, (tcp[:, -1] - tcp[:, context - 1]).norm(dim=1)


def _tracking(error: Tensor, way: Tensor) -> Statistics:
    counts = way > MIN_WAY_M
    return {"tcp_error": (error * counts).unsqueeze(1), "way": (way * counts).unsqueeze(1)}


def measure_best(
    model: WorldModel, clip: Clips, start: int, context: int, networks: Networks | None, sampling: Sampling
) -> Statistics:
    """The best of many futures of one clip, whose first row is `start`."""
    steps = clip.rgb.shape[1] - context
    latents = draw_latents(model, sampling.samples, steps, (sampling.seed, start))
    futures = predict_futures(model, clip, context, latents)
    judges = (networks.ranking, networks.deciding) if networks is not None and sampling.select == "vgg" else None
    chosen = futures.pick(best_future(futures, clip.rgb[:, context:], judges))
    statistics = _frames(chosen.rgb, chosen.depth, clip, context, networks)
    if chosen.inpainted is not None:
        statistics["inpainted"] = chosen.inpainted
    return statistics
