"""Scores of predicted video: pictures, depth, and motion against the simulator."""

from __future__ import annotations

import torch
from torch import Tensor
from torch.nn import functional as F

MOVING_M = 0.005
"""A pixel whose point truly moves farther than this from frame to frame is moving."""
STILL_M = 0.0005
"""One whose point moves less than this is still."""
SSIM_SIGMA = 1.5
"""Of the Gaussian window of SSIM, 11 pixels wide, in pixels."""


def squared_error(predicted: Tensor, target: Tensor) -> Tensor:
    """Mean squared error of each picture or depth image: `(..., C, H, W)` twice to (...)."""
    return (predicted - target).square().mean((-3, -2, -1))


def relative_depth_error(predicted: Tensor, target: Tensor) -> Tensor:
    """Mean of |predicted - target| / target (AbsRel) of each depth image: `(..., 1, H, W)` metres twice to (...)."""
    return ((predicted - target).abs() / target.clamp(min=1e-6)).mean((-3, -2, -1))


def ssim(predicted: Tensor, target: Tensor) -> Tensor:
    """Structural similarity (Wang et al. 2004) of pictures in [0, 1], each channel by itself, edges reflected.

    Args:
        predicted, target: (N, C, H, W), sides of more than 5 pixels.

    Returns:
        (N,), the mean over channels and pixels; 1 for equal pictures.
    """
    radius = 5
    window = torch.exp(-0.5 * (torch.arange(-radius, radius + 1, device=predicted.device) / SSIM_SIGMA).square())
    window = window / window.sum()

    def blur(x: Tensor) -> Tensor:
        x = F.pad(x.flatten(0, 1).unsqueeze(1), (radius,) * 4, mode="reflect")
        return F.conv2d(F.conv2d(x, window.view(1, 1, -1, 1)), window.view(1, 1, 1, -1)).view(predicted.shape)

    predicted = predicted.clamp(0, 1)
    mean, other = blur(predicted), blur(target)
    variance = (blur(predicted * predicted) - mean * mean).clamp(min=0)
    other_variance = (blur(target * target) - other * other).clamp(min=0)
    covariance = blur(predicted * target) - mean * other
    luminance, contrast = 0.01**2, 0.03**2
    likeness = (2 * mean * other + luminance) * (2 * covariance + contrast)
    likeness = likeness / ((mean * mean + other * other + luminance) * (variance + other_variance + contrast))
    return likeness.mean((1, 2, 3))


def adjusted_rand_index(ours: Tensor, theirs: Tensor) -> float:
    """How well two segmentations agree, whatever their labels are called (Hubert and Arabie 1985).

    Args:
        ours, theirs: (H, W) int64 labels, 0 or more.

    Returns:
        1 for the same segments, about 0 for segments that have nothing to do with each other.
    """
    width = int(theirs.max()) + 1
    joint = torch.bincount((ours * width + theirs).flatten(), minlength=(int(ours.max()) + 1) * width)
    joint = joint.view(-1, width).double()

    def pairs(counts: Tensor) -> float:
        return float((counts * (counts - 1)).sum() / 2)

    a, b = pairs(joint.sum(1)), pairs(joint.sum(0))
    expected, most = a * b / pairs(joint.sum()), (a + b) / 2
    return 1.0 if most == expected else (pairs(joint) - expected) / (most - expected)
