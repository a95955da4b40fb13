"""Predicted motion against the simulator's: flow in space and in the picture, disocclusion, segmentation by motion."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from envs import ground_truth
from envs.camera import CameraModel
from worldmodel.clips import Clips, ClipTruth
from worldmodel.metrics import MOVING_M, STILL_M, adjusted_rand_index
from worldmodel.rollout import Rollout
from worldmodel.scores import Statistics

LEAST_MOVING = 16
"""Frames in which fewer pixels than this move say nothing about segmentation."""


@dataclass(frozen=True)
class Motion:
    """Motion from each of P frames to the next."""

    scene_flow: Tensor
    """(B, P, 3, H, W) metres, camera frame."""
    optical_flow: Tensor
    """(B, P, 2, H, W) pixels."""
    disocclusion: Tensor
    """(B, P, H, W) bool, pixels of the next frame that nothing moves to."""
    parts: Tensor
    """(B, P, H, W) int64, the part that each pixel belongs to; 0 is the background, which does not move."""


def true_motion(camera: CameraModel, clips: Clips, truth: ClipTruth, context: int) -> Motion:
    """What really happened from the last context frame on; a part is a body where it moves."""
    flow = truth.scene_flow[:, context - 1 :]
    depth = clips.depth[:, context - 1 : -1, 0].cpu().numpy()
    field = flow.permute(0, 1, 3, 4, 2).numpy()
    optical = ground_truth.optical_flow(camera, depth, field)
    moving = flow.norm(dim=2) > MOVING_M
    return Motion(
        flow,
        torch.from_numpy(np.moveaxis(optical, -1, 2)),
        torch.from_numpy(ground_truth.disocclusion(camera, depth, field)),
        # The world too is a body, of number 0, and never moves.
        truth.bodies[:, context - 1 :] * moving,
    )


def predicted_motion(rollout: Rollout, context: int) -> Motion:
    """Of T3VIP from true frames; a part is what has the same largest mask, where it moves."""
    flow = rollout.stack("scene_flow")[:, context - 1 :].cpu()
    masks = rollout.stack("masks")[:, context - 1 :].argmax(2).cpu()
    return Motion(
        flow,
        rollout.stack("optical_flow")[:, context - 1 :].cpu(),
        rollout.stack("occlusion")[:, context - 1 :, 0].cpu() > 0.5,
        masks * (flow.norm(dim=2) > MOVING_M),
    )


def no_motion(truth: Motion) -> Motion:
    """That nothing moves, which is what copying a frame says."""
    return Motion(*(torch.zeros_like(field) for field in vars(truth).values()))


def flow_statistics(predicted: Tensor, true: Tensor, hand: Tensor) -> Statistics:
    """What the scores of scene flow are made of, summed over the frames of a clip, (B, 1) each.

    Args:
        predicted, true: (B, P, 3, H, W) metres.
        hand: (B, P, H, W) bool, pixels of the end-effector.
    """
    length, error = true.norm(dim=2), (predicted - true).norm(dim=2)
    moving, still = length > MOVING_M, length < STILL_M
    hand = hand & moving
    pixels = {
        "moving": moving,
        "moving_error": error * moving,
        "moving_length": length * moving,
        "hand": hand,
        "hand_error": error * hand,
        "hand_length": length * hand,
        "still": still,
        "still_flow": predicted.norm(dim=2) * still,
    }
    return _sums(pixels)


def motion_statistics(predicted: Motion, truth: Motion, hand: Tensor) -> Statistics:
    """What all motion scores are made of, summed over the frames of a clip, (B, 1) each.

    Args:
        hand: (B, P, H, W) bool, pixels of the end-effector.
    """
    error_px = (predicted.optical_flow - truth.optical_flow).norm(dim=2)
    ours, theirs = predicted.disocclusion, truth.disocclusion
    pixels = {
        "moving_error_px": error_px * (truth.scene_flow.norm(dim=2) > MOVING_M),
        "found": ours & theirs,
        "invented": ours & ~theirs,
        "missed": ~ours & theirs,
    }
    flow = flow_statistics(predicted.scene_flow, truth.scene_flow, hand)
    return flow | _sums(pixels) | _segmentation(predicted.parts, truth.parts)


def _sums(pixels: dict[str, Tensor]) -> Statistics:
    return {name: field.double().sum((1, 2, 3)).unsqueeze(1) for name, field in pixels.items()}


def _segmentation(ours: Tensor, theirs: Tensor) -> Statistics:
    """Sums over the frames in which something moves."""
    sums = torch.zeros((len(ours), 3), dtype=torch.float64)
    for b, t in ((theirs > 0).sum((2, 3)) >= LEAST_MOVING).nonzero().tolist():
        a, other = ours[b, t], theirs[b, t]
        sums[b, 0] += 1
        sums[b, 1] += adjusted_rand_index((a > 0).long(), (other > 0).long())
        sums[b, 2] += adjusted_rand_index(a, other)
    return {"frames_in_motion": sums[:, :1], "motion_ari": sums[:, 1:2], "body_ari": sums[:, 2:]}
