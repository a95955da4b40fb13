"""Pictures of predictions beside the truth: RGB, depth, masks, scene flow, optical flow, occlusion."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from envs import ground_truth
from envs.camera import CameraModel
from worldmodel import colours
from worldmodel.clips import Clips, ClipTruth
from worldmodel.colours import Image
from worldmodel.figure import TRUTH, Storyboard, Strip, write_sheet
from worldmodel.legends import DEPTH, MASKS, OCCLUSION, OPTICAL_FLOW, RGB, SCENE_FLOW, Scales
from worldmodel.rollout import unroll
from worldmodel.sampling import draw_latents, predict_futures
from worldmodel.t3vip import CloudPrediction
from worldmodel.world_model import Prediction, WorldModel

MOVES_M, MOVES_PX = 0.001, 0.1
"""Shorter flow does not count when the colours' full length is chosen."""


@dataclass(frozen=True)
class Shown:
    """What one model says about a clip."""

    name: str
    """How it is called in the figure."""
    model: WorldModel
    predictions: Sequence[Prediction]
    """Of frames 1 .. T-1, free-running after the context, latents at 0."""
    samples: Tensor | None = None
    """(N, P, 3, H, W) the predicted frames again, from N latents of the prior."""

    @property
    def clouds(self) -> list[CloudPrediction]:
        """The predictions of a model that knows space; none of a model of pictures."""
        return [prediction for prediction in self.predictions if isinstance(prediction, CloudPrediction)]


@torch.inference_mode()
def predict(name: str, model: WorldModel, clips: Clips, context: int, samples: int = 0, seed: int = 0) -> Shown:
    """Let a model predict the first of some clips.

    Args:
        name: how to call it.
        model: left in the mode it was in.
        clips: T frames; what comes after the first `context` of them is not looked at.
        context: frames that the model sees.
        samples: futures from latents of the prior, besides the one with latents at 0; none of a deterministic model.
        seed: of these latents.
    """
    was_training = model.training
    model.eval()
    clip = _first(clips).to(model.device)
    predictions = unroll(model, clip, context).predictions
    drawn = None
    if samples and model.latent_shape[0]:
        latents = draw_latents(model, samples, clip.rgb.shape[1] - context, (seed,))
        drawn = predict_futures(model, clip, context, latents).rgb.cpu()
    model.train(was_training)
    return Shown(name, model, predictions, drawn)


def storyboard(
    clips: Clips, truth: ClipTruth | None, context: int, models: Sequence[Shown], frame_seconds: float
) -> Storyboard:
    """The paper's qualitative figure of the first clip: in each section the truth, where it is known, and each model.

    What is seen in frame t belongs to column t; so does the motion that led there from frame t-1, and what that
    motion uncovered. The true flow starts from true frames, the predicted one from predicted frames.

    Args:
        clips: the clip that the models predicted.
        truth: motion, where the dataset knows it.
        context: frames that the models saw.
        models: at least one, all of one camera and frame gap.
        frame_seconds: from one frame to the next.
    """
    camera, blank = models[0].model.camera, [None] * context
    spatial = [shown for shown in models if shown.clouds]
    motion = None if truth is None else TrueMotion.of(camera, clips, truth)
    scales = _scales(camera, clips, motion, spatial)
    near, far = scales.near, scales.far
    strips = [Strip(RGB, TRUTH, [colours.rgb_colours(picture) for picture in clips.rgb[0]])]
    for shown in models:
        strips.append(_strip(RGB, shown, context, [colours.rgb_colours(p.rgb[0]) for p in shown.predictions]))
        for number, future in enumerate(() if shown.samples is None else shown.samples):
            drawn = [*blank, *(colours.rgb_colours(picture) for picture in future)]
            strips.append(Strip(RGB, f"{shown.name}, sample {number + 1}", drawn))
    if spatial:
        strips.append(Strip(DEPTH, TRUTH, [colours.depth_colours(d, near, far) for d in clips.depth[0]]))
    for shown in spatial:
        depths = [colours.depth_colours(p.depth[0], near, far) for p in shown.clouds]
        strips.append(_strip(DEPTH, shown, context, depths))
    for shown in models:
        strips.append(_strip(MASKS, shown, context, [_masks(p, shown.model) for p in shown.predictions]))
    for section in (SCENE_FLOW, OPTICAL_FLOW, OCCLUSION) if spatial else ():
        if motion is not None:
            strips.append(Strip(section, TRUTH, [*blank, *motion.pictures(section, scales)[context - 1 :]]))
        for shown in spatial:
            strips.append(_strip(section, shown, context, [_motion(section, p, scales) for p in shown.clouds]))
    return Storyboard(strips, scales, context, frame_seconds)


@dataclass(frozen=True)
class TrueMotion:
    """What the simulator knows about a clip; index t leads from frame t to frame t+1."""

    scene_flow: Tensor
    """(T-1, 3, H, W) metres."""
    optical_flow: Tensor
    """(T-1, 2, H, W) pixels."""
    occlusion: Tensor
    """(T-1, 1, H, W), 1 on pixels of frame t+1 on which no point of frame t lands."""

    @classmethod
    def of(cls, camera: CameraModel, clips: Clips, truth: ClipTruth) -> TrueMotion:
        """All that follows from depth and scene flow of the first clip."""
        depth = clips.depth[0, :-1, 0].cpu().numpy()
        flow = truth.scene_flow[0].permute(0, 2, 3, 1).cpu().numpy()
        optical = torch.from_numpy(ground_truth.optical_flow(camera, depth, flow)).permute(0, 3, 1, 2)
        hidden = torch.from_numpy(ground_truth.disocclusion(camera, depth, flow)).float().unsqueeze(1)
        return cls(truth.scene_flow[0], optical.nan_to_num(), hidden)

    def pictures(self, section: str, scales: Scales) -> list[Image]:
        """One for each step."""
        if section == SCENE_FLOW:
            return [colours.scene_flow_colours(flow, scales.scene_flow) for flow in self.scene_flow]
        if section == OPTICAL_FLOW:
            return [colours.colour_wheel(flow, scales.optical_flow) for flow in self.optical_flow]
        return [colours.occlusion_colours(mask) for mask in self.occlusion]


def picture_prediction(
    model: WorldModel,
    clips: Clips,
    truth: ClipTruth | None,
    context: int,
    frame_seconds: float,
    path: Path,
    scale: int = 2,
) -> None:
    """Write a PNG of a free-running prediction of the first clip beside the truth; see `storyboard`."""
    shown = predict(model.kind.upper(), model, clips, context)
    board = storyboard(_first(clips), truth, context, [shown], frame_seconds)
    write_sheet(board, path, clips.rgb.shape[1] - context, scale)


def _first(clips: Clips) -> Clips:
    return Clips(clips.rgb[:1], clips.depth[:1], clips.actions[:1])


def _strip(section: str, shown: Shown, context: int, pictures: list[Image]) -> Strip:
    """Pictures of all predictions, of which only those after the context are the model's own."""
    return Strip(section, shown.name, [*[None] * context, *pictures[context - 1 :]])


def _masks(prediction: Prediction, model: WorldModel) -> Image:
    masks = prediction.masks[0]
    if isinstance(prediction, CloudPrediction):
        return colours.mask_colours(masks)
    # Of the current frame, the kernels, the painted picture, and in some models the first frame.
    last = len(masks) - 1
    if model.copies_first:
        return colours.mask_colours(masks, still=(0, last), painted=(last - 1,))
    return colours.mask_colours(masks, painted=(last,))


def _motion(section: str, prediction: CloudPrediction, scales: Scales) -> Image:
    if section == SCENE_FLOW:
        return colours.scene_flow_colours(prediction.scene_flow[0], scales.scene_flow)
    if section == OPTICAL_FLOW:
        return colours.colour_wheel(prediction.optical_flow[0], scales.optical_flow)
    return colours.occlusion_colours(prediction.occlusion[0])


def _scales(camera: CameraModel, clips: Clips, motion: TrueMotion | None, spatial: Sequence[Shown]) -> Scales:
    """Colours over what the true clip spans; flow that nobody knows over what the first model predicts, less noise."""
    depth = clips.depth[0].cpu().numpy()
    inside = depth[depth < camera.far - 1e-3 * (camera.far - camera.near)]
    near, far = np.quantile(inside, (0.01, 0.99)) if inside.size else (camera.near, camera.far)
    far = max(far, near + 0.01)
    if motion is not None:
        scene, optical = motion.scene_flow, motion.optical_flow
    elif spatial:
        scene = torch.cat([prediction.scene_flow for prediction in spatial[0].clouds])
        optical = torch.cat([prediction.optical_flow for prediction in spatial[0].clouds])
    else:
        scene, optical = torch.zeros(3, 1, 1), torch.zeros(2, 1, 1)
    full = [colours.full_length(scene, MOVES_M), colours.full_length(optical, MOVES_PX)]
    if motion is None:
        full = [max(length, 10 * least) for length, least in zip(full, (MOVES_M, MOVES_PX), strict=True)]
    return Scales(float(near), float(far), *full)
