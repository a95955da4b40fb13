"""Numbers as colours: RGB, depth, masks, scene flow, optical flow on the colour wheel, occlusion."""

from __future__ import annotations

import math
from collections.abc import Sequence

import matplotlib
import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

Image = NDArray[np.uint8]
"""(H, W, 3)."""

PAPER = 250
"""Grey level of what a picture leaves empty: told from the page, but hardly."""
INK = 60
"""Grey level of what it marks."""
PALETTE = np.array(
    [
        [0.26, 0.47, 0.80],
        [0.93, 0.46, 0.20],
        [0.23, 0.66, 0.42],
        [0.84, 0.25, 0.31],
        [0.55, 0.38, 0.76],
        [0.16, 0.69, 0.75],
        [0.90, 0.68, 0.13],
        [0.87, 0.44, 0.66],
        [0.54, 0.40, 0.31],
        [0.60, 0.72, 0.24],
    ]
)
"""Of masks and models, RGB in [0, 1]."""
_ROUND = (1, 1.5, 2, 3, 4, 5, 6, 8, 10)


def rgb_colours(picture: Tensor) -> Image:
    """(3, H, W) in [0, 1] to (H, W, 3) uint8."""
    return (255 * picture.clamp(0, 1)).round().byte().permute(1, 2, 0).cpu().numpy()


def depth_colours(depth: Tensor, near: float, far: float) -> Image:
    """(1, H, W) metres to (H, W, 3) uint8: `near` is bright, `far` and beyond dark."""
    scaled = ((far - depth[0]) / (far - near)).clamp(0, 1).cpu().numpy()
    return (255 * matplotlib.colormaps["magma"](scaled)[..., :3]).round().astype(np.uint8)


def mask_colours(masks: Tensor, still: Sequence[int] = (0,), painted: Sequence[int] = ()) -> Image:
    """Masks as colours: nearly white what stays in place, dark what is painted, each other mask a colour of its own.

    Where several of the others share a pixel their colours are blended by the squares of their shares, so that the
    largest can be told in the mixture.

    Args:
        masks: (K, H, W), sums to 1 over K.
        still: which masks belong to what stays.
        painted: which masks belong to what is painted anew.

    Returns:
        (H, W, 3) uint8.
    """
    moving = [k for k in range(len(masks)) if k not in still and k not in painted]
    palette = torch.from_numpy(PALETTE[np.arange(len(moving)) % len(PALETTE)]).to(masks)
    parts = masks[moving]
    squares = parts.square() / parts.square().sum(0).clamp(min=1e-12) * parts.sum(0)
    colours = torch.einsum("khw,kc->hwc", squares, palette)
    plain = (PAPER * masks[list(still)].sum(0) + INK * masks[list(painted)].sum(0)) / 255
    return (255 * (colours + plain.unsqueeze(-1))).clamp(0, 255).round().byte().cpu().numpy()


def scene_flow_colours(flow: Tensor, full: float) -> Image:
    """(3, H, W) metres to (H, W, 3) uint8: grey is still; x, y, z add red, green, blue, all of it at `full` metres."""
    return (255 * (0.5 + 0.5 * (flow / full).clamp(-1, 1))).byte().permute(1, 2, 0).cpu().numpy()


def colour_wheel(flow: Tensor, full: float) -> Image:
    """A 2D field as colours: the direction is the hue, the length the saturation, still is white.

    Args:
        flow: (2, H, W), to the right and downwards.
        full: length of full saturation.

    Returns:
        (H, W, 3) uint8.
    """
    field = flow.detach().float().cpu().numpy()
    hue = np.arctan2(field[1], field[0]) / (2 * np.pi) % 1.0
    saturation = np.clip(np.hypot(field[0], field[1]) / full, 0, 1)
    colours = matplotlib.colors.hsv_to_rgb(np.stack((hue, saturation, np.ones_like(hue)), axis=-1))
    return (255 * colours).astype(np.uint8)


def wheel_legend(size: int) -> Image:
    """The colour wheel itself, (size, size, 3) uint8: what colour each direction gets."""
    axis = torch.linspace(-1, 1, size)
    v, u = torch.meshgrid(axis, axis, indexing="ij")
    legend = colour_wheel(torch.stack((u, v)), 1.0)
    legend[(u.square() + v.square() > 1).numpy()] = 255
    return legend


def occlusion_colours(mask: Tensor) -> Image:
    """(1, H, W) in [0, 1] to (H, W, 3) uint8: dark where it is 1."""
    return (PAPER - (PAPER - INK) * mask[0]).byte().unsqueeze(-1).expand(-1, -1, 3).cpu().numpy()


def full_length(flow: Tensor, least: float) -> float:
    """A round length at which moving pixels get their full colour.

    Args:
        flow: (..., C, H, W).
        least: shorter flow does not count as motion; ten times this where nothing moves.
    """
    lengths = flow.detach().float().norm(dim=-3)
    moving = lengths[lengths > least]
    if not len(moving):
        return 10 * least
    long = float(np.quantile(moving.cpu().numpy(), 0.95))
    unit = 10.0 ** math.floor(math.log10(long))
    return unit * next(step for step in _ROUND if step * unit >= long * 0.999)
