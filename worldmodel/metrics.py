"""Scores of predicted video: pictures, depth, and motion against the simulator."""

from __future__ import annotations

import torch
from torch import Tensor

MOVING_M = 0.005
"""A pixel whose point truly moves farther than this from frame to frame is moving."""
STILL_M = 0.0005
"""One whose point moves less than this is still."""


def psnr_per_step(predicted: Tensor, target: Tensor) -> Tensor:
    """PSNR of pictures in [0, 1], of the mean squared error over all clips: `(B, T, C, H, W)` twice to (T,) dB."""
    error = (predicted.clamp(0, 1) - target).square().mean((0, 2, 3, 4))
    return -10 * torch.log10(error.clamp(min=1e-12))


def rmse_per_step(predicted: Tensor, target: Tensor) -> Tensor:
    """Root mean squared error over all clips: `(B, T, C, H, W)` twice to (T,), in their unit."""
    return (predicted - target).square().mean((0, 2, 3, 4)).sqrt()


def relative_flow_error(predicted: Tensor, true: Tensor, where: Tensor) -> float:
    """Mean end-point error over the mean length of the true flow on the pixels `where`: 1 is predicting no motion.

    Args:
        predicted, true: (..., 3, H, W) metres.
        where: (..., H, W) bool.
    """
    error = (predicted - true).norm(dim=-3)[where].mean()
    return float(error / true.norm(dim=-3)[where].mean())


def flow_scores(predicted: Tensor, true: Tensor, hand: Tensor) -> dict[str, float]:
    """Motion against the simulator.

    Args:
        predicted, true: (B, T, 3, H, W) scene flow, metres.
        hand: (B, T, H, W) bool.

    Returns:
        `flow_error_moving`, `flow_error_hand` (relative to predicting no motion), `false_flow_m` (mean length
        predicted on still pixels).
    """
    length = true.norm(dim=2)
    moving = length > MOVING_M
    return {
        "flow_error_moving": relative_flow_error(predicted, true, moving),
        "flow_error_hand": relative_flow_error(predicted, true, moving & hand),
        "false_flow_m": float(predicted.norm(dim=2)[length < STILL_M].mean()),
    }
