"""Differentiable forward warping: every pixel of a picture is thrown to where its flow sends it.

Bilinear splatting is the transpose of bilinear sampling. PyTorch has the transpose already, as the gradient of
`grid_sample` with respect to its input, natively on every device; here it becomes an operator with gradients of its
own, which are again one `grid_sample` and one of its gradients. Nothing is materialised per corner.
"""

from __future__ import annotations

from typing import Any, Literal

import torch
from torch import Tensor

SplatMode = Literal["over", "average", "softmax", "sum"]
MIN_COVERAGE = 0.5
"""A pixel on which less than half a pixel's worth of source points lands counts as disoccluded."""

LAYER_GAP_M = 0.01
"""In mode `over`, a point this much in front of, or behind, the mean of all that land around it is another layer."""
MIN_WEIGHT = 1e-4

_FAR_OUTSIDE = 4.0  # in normalised coordinates, where the picture is [-1, 1]: dropped by zero padding
_BILINEAR, _ZEROS, _BORDER, _ALIGN_CORNERS = 0, 0, 1, True


def _scatter(values: Tensor, grid: Tensor) -> Tensor:
    if _order_matters(values):
        return _scatter_in_order(values, grid)
    # The second argument, the picture that was sampled, is not looked at for this gradient.
    out, _ = torch.ops.aten.grid_sampler_2d_backward(
        values, values, grid, _BILINEAR, _ZEROS, _ALIGN_CORNERS, (True, False)
    )
    return out


def _order_matters(values: Tensor) -> bool:
    """Whether sums must have the same bits in every run, on a device whose threads add in any order."""
    return values.is_cuda and torch.are_deterministic_algorithms_enabled()


def _scatter_in_order(values: Tensor, grid: Tensor) -> Tensor:
    """`_scatter` by `index_add` of the four corners, which PyTorch has in a deterministic kind for GPUs too."""
    batch, channels, height, width = values.shape
    x, y = (0.5 * (side - 1) * (grid[..., axis] + 1) for axis, side in enumerate((width, height)))
    left, top = x.floor(), y.floor()
    source = values.permute(0, 2, 3, 1)
    first = (height * width * torch.arange(batch, device=values.device)).view(-1, 1, 1)
    out = values.new_zeros((batch * height * width, channels))
    for column, share in ((left, left + 1 - x), (left + 1, x - left)):
        for row, part in ((top, top + 1 - y), (top + 1, y - top)):
            inside = (column >= 0) & (column < width) & (row >= 0) & (row < height)
            index = first + row.clamp(0, height - 1).long() * width + column.clamp(0, width - 1).long()
            weighted = source * (share * part * inside).unsqueeze(-1)
            out.index_add_(0, index.flatten(), weighted.reshape(-1, channels))
    return out.view(batch, height, width, channels).permute(0, 3, 1, 2).contiguous()


def _grid_gradient(values: Tensor, gradient: Tensor, grid: Tensor) -> Tensor:
    """Of `_scatter` with respect to the grid. Each thread writes a place of its own here, yet PyTorch refuses this
    operator in deterministic mode for what it does with its input's gradient, which is left out."""
    ordered = _order_matters(values)
    if ordered:
        torch.use_deterministic_algorithms(False)
    try:
        _, found = torch.ops.aten.grid_sampler_2d_backward(
            values, gradient, grid, _BILINEAR, _ZEROS, _ALIGN_CORNERS, (False, True)
        )
    finally:
        if ordered:
            torch.use_deterministic_algorithms(True)
    return found


class _BilinearSplat(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, values: Tensor, grid: Tensor) -> Tensor:
        ctx.save_for_backward(values, grid)
        return _scatter(values, grid)

    @staticmethod
    def backward(ctx: Any, *gradients: Tensor) -> tuple[Tensor, Tensor]:
        values, grid = ctx.saved_tensors
        (gradient,) = gradients
        gradient = gradient.contiguous()
        sampled = torch.grid_sampler_2d(gradient, grid, _BILINEAR, _ZEROS, _ALIGN_CORNERS)
        return sampled, _grid_gradient(values, gradient, grid)


def splat_sum(values: Tensor, pixels: Tensor) -> Tensor:
    """Throw each value to a place of the picture, shared bilinearly among the four pixels around it, and add up.

    What lands outside the picture is lost.

    Args:
        values: (B, C, H, W).
        pixels: (B, 2, H, W), where each one goes, (u, v) in pixels; finite.

    Returns:
        (B, C, H, W), differentiable in both arguments.
    """
    return _BilinearSplat.apply(values.contiguous(), _grid(pixels))


def _grid(pixels: Tensor) -> Tensor:
    """Pixels as `grid_sample` wants them: (B, H, W, 2) with the picture in [-1, 1]."""
    height, width = pixels.shape[-2:]
    u, v = pixels.unbind(1)
    grid = torch.stack((u * (2.0 / max(width - 1, 1)) - 1.0, v * (2.0 / max(height - 1, 1)) - 1.0), dim=-1)
    return grid.clamp(-_FAR_OUTSIDE, _FAR_OUTSIDE).contiguous()


def _around(values: Tensor, grid: Tensor) -> Tensor:
    """Bilinearly at each place, beyond the edge as on it: what is half outside still lies over what is there."""
    return torch.grid_sampler_2d(values, grid, _BILINEAR, _BORDER, _ALIGN_CORNERS)


@torch.no_grad()
def _visible(pixels: Tensor, depth: Tensor, in_front: Tensor) -> Tensor:
    """How much of each point is seen when nearer points lie over it, in [0, 1]: (B, 1, H, W).

    Around the place where a point lands, what is nearer than the mean forms the upper layer; a point behind the mean
    is hidden by as much as the upper layer covers there. So a surface that moves by a tenth of a pixel hides a tenth
    of the next pixel, where weights like exp(-5 z) would have it hide the whole pixel.
    """
    grid = _grid(pixels)
    depth_sum, count = _scatter(torch.cat((depth * in_front, in_front), dim=1), grid).split(1, dim=1)
    mean = _around(depth_sum / count.clamp(min=1e-6), grid)
    upper = in_front * (depth < mean - LAYER_GAP_M)
    cover = _around(_scatter(upper, grid), grid)
    return torch.where(depth > mean + LAYER_GAP_M, 1 - cover.clamp(0, 1), 1.0)


def splat(
    values: Tensor, pixels: Tensor, depth: Tensor, mode: SplatMode = "over", sharpness: float = 0.0
) -> tuple[Tensor, Tensor]:
    """Forward-warp a picture (after softmax splatting, Niklaus and Liu 2020), points behind the camera dropped.

    Args:
        values: (B, C, H, W).
        pixels: (B, 2, H, W), target places in pixels.
        depth: (B, 1, H, W), depth of the moved points in metres: nearer ones win in mode `softmax`.
        mode: `average` shares a pixel among all that land on it; `over` lays nearer points over farther ones as far as
            they cover them (no gradient through who covers whom); `softmax` weights by exp(-sharpness * depth);
            `sum` adds up.
        sharpness: in 1/metre, for `softmax`; 0 is `average`.

    Returns:
        The warped picture (B, C, H, W), 0 where nothing lands, and the coverage (B, 1, H, W): how many source points
        land on each pixel, before any weighting by depth.
    """
    in_front = (depth > 1e-3).to(values.dtype)
    weights = in_front
    if mode == "over":
        weights = in_front * _visible(pixels.detach(), depth.detach(), in_front).clamp(min=MIN_WEIGHT)
    if mode == "softmax" and sharpness > 0:
        # Shifting by the mean leaves the result as it is. The range keeps far points above the divisor's least value.
        weights = in_front * torch.exp((sharpness * (depth.mean((1, 2, 3), keepdim=True) - depth)).clamp(-20, 20))
    landed = splat_sum(torch.cat((values * weights, weights, in_front), dim=1), pixels)
    picture, total, coverage = landed.split((values.shape[1], 1, 1), dim=1)
    if mode == "sum":
        return picture, coverage
    return picture / total.clamp(min=1e-12), coverage
