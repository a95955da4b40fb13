"""Following designated pixels through predicted kernels: what a model of pictures can say about where a thing will be.

A distribution over the pixels of the current frame goes the way of the colours (Finn and Levine 2017, "Deep visual
foresight"): through the same kernels, blended by the same masks. What the mask takes from the current frame stays;
what it takes from the first frame is where the designated pixels were then; what it takes from the generated picture
came from nowhere, so that this mass is lost. The rest is scaled up to sum 1.

Among the pixels near a hand some show the table behind it, and the masks are soft: the mean of the distribution would
lag behind the hand. So the track also adds up how far the kernels take what they move, as `HandTrack` sets the
background apart for a model of rigid motions.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor
from torch.nn import functional as F

from worldmodel.advection import convolve_padded
from worldmodel.geometry import pixel_grid
from worldmodel.kernels import KernelPrediction

GRID = 8  # pixels
LEAST_MOVED = 0.02  # below this share of mass that kernels move, it counts as still
Box = tuple[int, int, int, int]
"""Rows top to bottom and columns left to right of a window, the ends not included."""


def uniform_pixels(indices: Tensor, height: int, width: int) -> Tensor:
    """The same mass on each of some pixels, which are indices (M,) into H*W row by row: (H, W) that sums to 1."""
    distribution = torch.zeros(height * width, device=indices.device)
    distribution[indices] = 1 / len(indices)
    return distribution.view(height, width)


@dataclass(frozen=True, eq=False)
class PixelTrack:
    """Where the designated pixels are in N imagined futures.

    Attributes:
        distribution: (N, H, W), sums to 1 in each future. N is 1 at the start, from which any number of futures begin.
            A future in which all mass was lost is NaN from then on.
        shift: (N, 2), how far (u, v) the kernels have taken the mass that they moved, pixels: the mean at each step,
            added up over the steps.
        first: (1, H, W), the designated pixels of the first frame that the model was shown.
        box: the window outside of which there is no mass, in no future.
    """

    distribution: Tensor
    shift: Tensor
    first: Tensor
    box: Box

    @classmethod
    def start(cls, now: Tensor, first: Tensor | None = None) -> PixelTrack:
        """Designate pixels.

        Args:
            now: (H, W) distribution over the current frame, sums to 1.
            first: (H, W) over the first frame that the model was shown; `now` when there was no other.
        """
        first = now if first is None else first
        rows, columns = (now + first).nonzero().unbind(1)
        box = int(rows.min()), int(rows.max()) + 1, int(columns.min()), int(columns.max()) + 1
        return cls(now[None], now.new_zeros((1, 2)), first[None], _rounded(box, *now.shape))

    def advance(self, prediction: KernelPrediction) -> PixelTrack:
        """One predicted step on.

        Mass can go no farther than a kernel reaches, so only a window that grows by that is computed. Mass that leaves
        the picture is lost, and none comes in: edges are not repeated here, as they are for colours.

        Args:
            prediction: of N futures.
        """
        masks, kernels = prediction.masks, prediction.kernels
        futures, count, size = kernels.shape[:3]
        height, width = masks.shape[-2:]
        reach = size // 2
        top, bottom, left, right = self.box
        box = _rounded((top - reach, bottom + reach, left - reach, right + reach), height, width)
        seen = (..., slice(box[0], box[1]), slice(box[2], box[3]))
        masks, now, first = masks[seen], self.distribution[:, None][seen], self.first[seen]
        grid = pixel_grid(height, width).to(now)[seen]
        sources = torch.cat((now, now * grid), dim=1)  # (N or 1, 3, h, w): mass, and where it is
        padded = F.pad(sources, (reach,) * 4).expand(futures, -1, -1, -1)
        moved = torch.einsum("nkhw,nkchw->nchw", masks[:, 1 : 1 + count], convolve_padded(padded, kernels))
        mass = masks[:, 0] * now[:, 0] + moved[:, 0]
        if masks.shape[1] > count + 2:  # current frame, kernels, generated picture, first frame
            mass = mass + masks[:, count + 2] * first
        total = mass.sum(dim=(1, 2), keepdim=True)
        distribution = mass.new_zeros((futures, height, width))
        distribution[seen] = mass / total
        share, *origin = (moved.sum(dim=(2, 3)) / total[:, 0]).unbind(1)
        way = torch.einsum("nhw,chw->nc", moved[:, 0] / total, grid) - torch.stack(origin, dim=1)
        shift = self.shift + way / share.clamp(min=LEAST_MOVED)[:, None]
        return PixelTrack(distribution, shift, self.first, box)

    def expected_position(self) -> Tensor:
        """(N, 2), the mean pixel (u, v)."""
        return torch.einsum("nhw,chw->nc", self.distribution, self._grid())

    def expected_distance(self, goal: Tensor) -> Tensor:
        """(N,), the mean distance in pixels to `goal`, a pixel (u, v)."""
        distance = (self._grid() - goal[:, None, None]).norm(dim=0)
        return torch.einsum("nhw,hw->n", self.distribution, distance)

    def _grid(self) -> Tensor:
        grid = pixel_grid(*self.distribution.shape[-2:])
        return grid.to(self.distribution)


def _rounded(box: Box, height: int, width: int) -> Box:
    """The box within the picture, its edges on every 8th pixel.

    Windows of ever other sizes would leave the memory that they are made in full of holes: the process grew by half a
    gigabyte an episode.
    """
    top, bottom, left, right = box
    lows = (max(low // GRID * GRID, 0) for low in (top, left))
    highs = (min(-(-high // GRID) * GRID, size) for high, size in ((bottom, height), (right, width)))
    (top, left), (bottom, right) = lows, highs
    return top, bottom, left, right
