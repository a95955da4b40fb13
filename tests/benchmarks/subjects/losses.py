"""The alignment losses and the splat, forward and backward."""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor

from tests.benchmarks import plain
from tests.benchmarks.timing import median_seconds, peak_mebibytes
from worldmodel import losses, splatting

PIXEL_M = 0.0115  # width of a pixel on the table, metres
ALIGNMENT: dict[str, Callable[[Tensor, Tensor, int], Tensor]] = {
    "ours": losses.knn_alignment,
    "plain": plain.knn_alignment,
    "chamfer": lambda moved, target, radius: losses.chamfer_alignment(moved, target),
    "plain chamfer": lambda moved, target, radius: plain.chamfer_alignment(moved, target),
}


def alignment_seconds(kind: str, frames: int, size: int, radius: int, repeats: int) -> float:
    """Seconds of an alignment loss, forward and backward, on this many pairs of clouds."""
    return median_seconds(_alignment(kind, frames, size, radius), repeats)


def alignment_mebibytes(kind: str, frames: int, size: int, radius: int) -> float:
    """MiB that an alignment loss takes at its peak, forward and backward."""
    return peak_mebibytes(_alignment(kind, frames, size, radius))


def splat_seconds(kind: str, frames: int, size: int, repeats: int) -> float:
    """Seconds of splatting RGB-D, forward and backward, in mode `average`."""
    rng = torch.Generator().manual_seed(0)
    values = torch.rand((frames, 4, size, size), generator=rng, requires_grad=True)
    depth = 4 + torch.rand((frames, 1, size, size), generator=rng)
    grid = torch.stack(torch.meshgrid(torch.arange(size), torch.arange(size), indexing="xy")).float()
    pixels = (grid + 2 * torch.randn((frames, 2, size, size), generator=rng)).requires_grad_()
    forward: dict[str, Callable[[], tuple[Tensor, Tensor]]] = {
        "ours": lambda: splatting.splat(values, pixels, depth, "average"),
        "plain": lambda: plain.splat_average(values, pixels, depth),
    }

    def work() -> None:
        values.grad = pixels.grad = None
        picture, coverage = forward[kind]()
        (picture.square().sum() + coverage.square().sum()).backward()

    return median_seconds(work, repeats, warmup=2)


def clouds(frames: int, size: int) -> tuple[Tensor, Tensor]:
    """A target cloud as a camera sees it, and one that is a centimetre off: (frames, 3, size, size) metres each."""
    rng = torch.Generator().manual_seed(0)
    grid = torch.stack(torch.meshgrid(torch.arange(size), torch.arange(size), indexing="xy")).float() * PIXEL_M
    depth = 4 + 0.5 * torch.rand((frames, 1, size, size), generator=rng)
    target = torch.cat((grid.expand(frames, 2, size, size), depth), dim=1)
    return target + 0.01 * torch.randn(target.shape, generator=rng), target


def _alignment(kind: str, frames: int, size: int, radius: int) -> Callable[[], None]:
    moved, target = clouds(frames, size)
    moved.requires_grad_()

    def work() -> None:
        moved.grad = None
        ALIGNMENT[kind](moved, target, radius).backward()

    return work
