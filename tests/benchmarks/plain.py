"""The plain ways: what one would write first. Same results, more time and memory."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator
from dataclasses import replace
from typing import Any
from unittest import mock

import torch
from torch import Tensor
from torch.nn import functional as F

from worldmodel import geometry, losses
from worldmodel.blocks import LSTMState
from worldmodel.kernels import CDNA
from worldmodel.t3vip import T3VIP
from worldmodel.world_model import Memory, WorldModel

BEYOND_M = 1e4  # where the cloud ends: farther away than any true neighbour


class DefaultLayout(WorldModel):
    """Before a model's class: the same network in PyTorch's default memory layout."""

    def network(
        self, frame: Tensor, action: Tensor, latent: Tensor | None, states: list[LSTMState], paint: bool
    ) -> tuple[Any, list[LSTMState]]:
        found: tuple[Any, list[LSTMState]] = super().network(  # type: ignore[safe-super]  # that of the model's class
            frame.contiguous(), action, latent, states, paint
        )
        return found

    def blank_memory(self, like: Tensor) -> Memory:
        memory = super().blank_memory(like)
        return replace(memory, states=[(hidden.contiguous(), cell.contiguous()) for hidden, cell in memory.states])


class PlainT3VIP(DefaultLayout, T3VIP):
    pass


class PlainCDNA(DefaultLayout, CDNA):
    pass


PLAIN: dict[str, type[WorldModel]] = {plain.kind: plain for plain in (PlainT3VIP, PlainCDNA)}


@contextlib.contextmanager
def plain_operators() -> Iterator[None]:
    """Within the block every model sums over transformed clouds, and every kNN loss unfolds."""
    with (
        mock.patch.object(geometry, "blend_transforms", lambda masks, transforms: (masks, transforms)),
        mock.patch.object(geometry, "apply_transforms", sum_of_transformed),
        mock.patch.object(losses, "knn_alignment", knn_alignment),
    ):
        yield


def sum_of_transformed(parts: tuple[Tensor, Tensor], points: Tensor) -> Tensor:
    """Eq. (1) of the paper as it stands: K moved clouds, weighted by the masks and added up.

    Args:
        parts: masks (B, K, H, W) and transforms (B, K, 3, 4).
        points: (B, 3, H, W) metres.

    Returns:
        (B, 3, H, W) metres.
    """
    masks, transforms = parts
    clouds = torch.einsum("bkij,bjhw->bkihw", transforms[..., :3], points) + transforms[..., 3, None, None]
    return (masks.unsqueeze(2) * clouds).sum(1)  # (B, K, 3, H, W) -> (B, 3, H, W)


def knn_distance(query: Tensor, reference: Tensor, radius: int) -> Tensor:
    """`losses.knn_distance` with all distances of all windows in memory at once."""
    window = 2 * radius + 1
    padded = F.pad(reference, (radius,) * 4, value=BEYOND_M)
    neighbours = F.unfold(padded, window).unflatten(1, (3, window**2))  # (B, 3, k*k, HW)
    squared = (query.flatten(2).unsqueeze(2) - neighbours).square().sum(1)  # (B, k*k, HW)
    return (squared.min(1).values + 1e-12).sqrt().mean()


def knn_alignment(moved: Tensor, target: Tensor, radius: int) -> Tensor:
    """`losses.knn_alignment`, both directions by unfolding."""
    return knn_distance(moved, target, radius) + knn_distance(target, moved, radius)


def chamfer_alignment(moved: Tensor, target: Tensor) -> Tensor:
    """`losses.chamfer_alignment` by the matrix of all distances."""
    points, others = (cloud.flatten(2).transpose(1, 2) for cloud in (moved, target))  # (B, HW, 3)
    distances = torch.cdist(points, others, compute_mode="donot_use_mm_for_euclid_dist")  # (B, HW, HW)
    return distances.amin(2).mean() + distances.amin(1).mean()


def splat_average(values: Tensor, pixels: Tensor, depth: Tensor) -> tuple[Tensor, Tensor]:
    """`splatting.splat` in mode `average`: four corners, each added up by index."""
    batch, channels, height, width = values.shape
    in_front = (depth > 1e-3).to(values.dtype)
    source = torch.cat((values * in_front, in_front), dim=1).flatten(2).transpose(1, 2)  # (B, HW, C+1)
    u, v = pixels.flatten(2).unbind(1)  # (B, HW) each
    left, top = u.floor(), v.floor()
    landed = source.new_zeros((batch * height * width, channels + 1))
    start = torch.arange(batch, device=values.device).view(-1, 1) * (height * width)
    for across in (0, 1):
        for down in (0, 1):
            column, row = left + across, top + down
            share = (1 - (u - column).abs()) * (1 - (v - row).abs())
            inside = (column >= 0) & (column < width) & (row >= 0) & (row < height)
            index = start + (row.clamp(0, height - 1) * width + column.clamp(0, width - 1)).long()
            weighted = source * (share * inside).unsqueeze(-1)
            landed = landed.index_add(0, index.flatten(), weighted.flatten(0, 1))
    picture, coverage = landed.view(batch, height, width, -1).permute(0, 3, 1, 2).split((channels, 1), dim=1)
    return picture / coverage.clamp(min=1e-12), coverage
