"""The terms of the full objective (paper, III-D to III-F), each a mean, so that weights hold at any picture size."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal

import torch
from torch import Tensor

from envs.errors import UsageError
from worldmodel.compilation import compiled

EDGE_SHARPNESS = 10.0
"""How fast smoothness lets go at an edge of a picture in [0, 1]; with the paper's 1 an edge hardly counts."""
_BEYOND_M = 1e4  # where the cloud ends: farther away than any true neighbour
_CLOUDS_AT_ONCE = 16  # that are searched together for neighbours in windows
_AT_ONCE = 256  # points whose distances to a whole cloud are taken together


@dataclass(frozen=True)
class LossWeights:
    """lambda_1 to lambda_6 of the paper and its alpha."""

    rgb: float = 0.4
    """lambda_1, reconstruction of RGB in [0, 1]."""
    depth: float = 0.02
    """lambda_2, reconstruction of depth in metres."""
    knn: float = 0.018
    """lambda_3, alignment of the moved cloud with the next one, metres."""
    scene_smoothness: float = 5e-4
    """lambda_4, second differences of scene flow, metres."""
    optical_smoothness: float = 5e-4
    """lambda_5, second differences of optical flow, pixels."""
    kl: float = 0.1
    """lambda_6, divergence of the latents from the prior, nats a pixel. With 1e-3 latents told the model how
    everything moves, and it did not learn that from the actions. (The reference's is of a unit 512 times larger.)"""
    power: Literal[1, 2] = 1
    """alpha: 1 for absolute, 2 for squared reconstruction errors. `train-worldmodel` takes 2 for CDNA, SNA
    and SV2P where none is given."""
    alignment: Literal["knn", "chamfer"] = "knn"
    """Where a point's nearest neighbour is sought: in a window about its pixel, or (Hind4sight-Net's chamfer distance)
    in the whole cloud, which takes many times longer."""
    knn_radius: int = 5
    """The nearest neighbour is sought this many pixels to every side."""

    def __post_init__(self) -> None:
        for name in ("rgb", "depth", "knn", "scene_smoothness", "optical_smoothness", "kl"):
            if not 0 <= getattr(self, name) < math.inf:
                raise UsageError(
                    f"the loss weight {name} is {getattr(self, name)}; give 0 to leave the term out, or more"
                )
        if self.knn_radius < 1:
            raise UsageError(f"knn-radius is {self.knn_radius}; give at least 1 pixel")


def reconstruction(predicted: Tensor, target: Tensor, power: int) -> Tensor:
    """Mean absolute (power 1) or squared (power 2) error: Eq. (6)."""
    difference = predicted - target
    return difference.abs().mean() if power == 1 else difference.square().mean()


@compiled
def _scan_row(
    query: Tensor, rows: Tensor, best: Tensor, where: Tensor, first: Tensor, window: int
) -> tuple[Tensor, Tensor]:
    """One row of the window: the running minimum over its `window` shifts.

    Written out by coordinates, and with a minimum in place of a second choice, it compiles to one loop.
    """
    width = query.shape[-1]
    x, y, z = query.unbind(1)
    for shift in range(window):
        u, v, w = rows[..., shift : shift + width].unbind(1)
        distance = (x - u).square() + (y - v).square() + (z - w).square()
        where = torch.where(distance < best, first + shift, where)
        best = torch.minimum(distance, best)
    return best, where


def nearest_in_window(query: Tensor, reference: Tensor, radius: int) -> Tensor:
    """The nearest reference point of each query point among the (2 radius + 1)^2 pixels around its own.

    A running minimum over shifted views: it needs the memory of one distance a pixel, where `unfold` needs one a pixel
    and shift. A few clouds at a time, which stay in a core's cache.

    Args:
        query: (B, 3, H, W) metres.
        reference: (B, 3, H, W) metres.
        radius: in pixels.

    Returns:
        (B, H, W) int64, the flat index y * W + x of the nearest reference point.
    """
    with torch.no_grad():
        parts = zip(query.detach().split(_CLOUDS_AT_ONCE), reference.detach().split(_CLOUDS_AT_ONCE), strict=True)
        return torch.cat([_pixel_at(_nearest_shift(*part, radius), radius) for part in parts])


def _nearest_shift(query: Tensor, reference: Tensor, radius: int) -> Tensor:
    """(B, H, W) int32, which of the window's shifts leads to the nearest point."""
    window = 2 * radius + 1
    batch, _, height, width = query.shape
    query = query.contiguous()
    padded = torch.nn.functional.pad(reference, (radius,) * 4, value=_BEYOND_M)
    best = query.new_full((batch, height, width), float("inf"))
    # A point that is not finite has no nearest neighbour: it keeps its own pixel, and the loss is not finite.
    own = radius * window + radius
    where = torch.full((batch, height, width), own, dtype=torch.int32, device=query.device)
    for row in range(window):
        first = torch.full((), row * window, dtype=torch.int32, device=query.device)
        best, where = _scan_row(query, padded[:, :, row : row + height], best, where, first, window)
    return where


@compiled
def _pixel_at(shift: Tensor, radius: int) -> Tensor:
    """(B, H, W) int64, the flat index of the pixel to which a shift leads from each one's own."""
    window = 2 * radius + 1
    height, width = shift.shape[-2:]
    y = torch.arange(height, dtype=torch.int32, device=shift.device).view(-1, 1) + shift // window - radius
    x = torch.arange(width, dtype=torch.int32, device=shift.device) + shift % window - radius
    # Beside points that are not finite even the edge beyond the picture is near.
    return (y.clamp(0, height - 1) * width + x.clamp(0, width - 1)).long()


@compiled
def _nearest_row(points: Tensor, others: Tensor) -> Tensor:
    """(N,) index of the nearest of `others` (3, M) to each of `points` (3, N); compiled, no distance is ever stored."""
    return (points[:, :, None] - others[:, None]).square().sum(0).argmin(1)


def nearest_of_all(query: Tensor, reference: Tensor) -> Tensor:
    """The nearest reference point of each query point in the whole cloud.

    Some query points at a time, and by differences: |a|^2 + |b|^2 - 2ab is off by millimetres at 4 m.

    Args:
        query: (B, 3, H, W) metres.
        reference: (B, 3, H, W) metres.

    Returns:
        (B, H, W) int64, the flat index y * W + x of the nearest reference point.
    """
    batch, _, height, width = query.shape
    with torch.no_grad():
        points, others = query.detach().flatten(2), reference.detach().flatten(2)
        nearest = [
            _nearest_row(part.contiguous(), others[b]) for b in range(batch) for part in points[b].split(_AT_ONCE, 1)
        ]
        return torch.cat(nearest).view(batch, height, width)


@compiled
def _mean_distance(query: Tensor, reference: Tensor, nearest: Tensor) -> Tensor:
    """Mean distance of each query point to the reference point with its index (B, H, W), metres."""
    index = nearest.flatten(1).unsqueeze(1).expand(-1, 3, -1)
    neighbours = reference.flatten(2).gather(2, index)
    return ((query.flatten(2) - neighbours).square().sum(1) + 1e-12).sqrt().mean()


def knn_distance(query: Tensor, reference: Tensor, radius: int) -> Tensor:
    """Mean distance of each query point to its nearest reference point within the window, metres: Eqs. (8), (9)."""
    return _mean_distance(query, reference, nearest_in_window(query, reference, radius))


def knn_alignment(moved: Tensor, target: Tensor, radius: int) -> Tensor:
    """Both directions of the point cloud alignment: Eq. (10), `(B, 3, H, W)` metres each."""
    return knn_distance(moved, target, radius) + knn_distance(target, moved, radius)


def chamfer_distance(query: Tensor, reference: Tensor) -> Tensor:
    """Mean distance of each query point to its nearest reference point anywhere, metres."""
    return _mean_distance(query, reference, nearest_of_all(query, reference))


def chamfer_alignment(moved: Tensor, target: Tensor) -> Tensor:
    """`knn_alignment` with the whole picture for a window: what the paper's section III-D compares itself with."""
    return chamfer_distance(moved, target) + chamfer_distance(target, moved)


def alignment(moved: Tensor, target: Tensor, weights: LossWeights) -> Tensor:
    """The point cloud alignment that the options ask for, `(B, 3, H, W)` metres each."""
    if weights.alignment == "chamfer":
        return chamfer_alignment(moved, target)
    return knn_alignment(moved, target, weights.knn_radius)


@compiled
def edge_aware_smoothness(flow: Tensor, rgb: Tensor) -> Tensor:
    """Mean second difference of a flow, let go at edges of the picture it starts from (section III-E).

    Args:
        flow: (B, C, H, W) metres or pixels.
        rgb: (B, 3, H, W) in [0, 1].
    """
    total = flow.new_zeros(())
    for axis in (-1, -2):
        length = flow.shape[axis]
        slope = flow.diff(dim=axis)
        bend = slope.diff(dim=axis).abs().mean(1)
        edge = rgb.diff(dim=axis).abs().mean(1)
        edge = torch.maximum(edge.narrow(axis, 0, length - 2), edge.narrow(axis, 1, length - 2))
        total = total + (bend * torch.exp(-EDGE_SHARPNESS * edge)).mean()
    return total


def kl_to_prior(mean: Tensor, log_variance: Tensor, pixels: int) -> Tensor:
    """KL(N(mean, var) || N(0, I)), summed over a latent's dimensions, averaged over the rest, in nats a pixel: Eq. (7).

    Args:
        mean, log_variance: (..., Z, h, w).
        pixels: of one frame.
    """
    return divergence(mean, log_variance).sum((-3, -2, -1)).mean() / pixels


def divergence(mean: Tensor, log_variance: Tensor) -> Tensor:
    """KL(N(mean, var) || N(0, 1)) of each number, in nats; the shape stays."""
    return 0.5 * (mean.square() + log_variance.exp() - 1 - log_variance)
