"""Moving a picture by kernels: each pixel is a weighted sum of those around it, by K kernels that share it by masks.

Blend first, apply once: the masks blend the K kernels of a picture to one kernel a pixel, which is a matrix product,
and that is applied with a running sum over shifted views. K moved pictures are never made: same result as making
them, in less than half of the time forward and backward.
"""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor
from torch.nn import functional as F

from worldmodel.compilation import compiled


def convolve(picture: Tensor, kernels: Tensor) -> Tensor:
    """Each picture with each of its kernels, edges repeated: (B, C, H, W) and (B, K, S, S) to (B, K, C, H, W)."""
    batch, reach = len(picture), kernels.shape[-1] // 2
    pictures = picture[:1] if picture.stride(0) == 0 else picture  # expanded from one: nothing to be padded B times
    padded = F.pad(pictures, (reach,) * 4, mode="replicate")
    return convolve_padded(padded.expand(batch, -1, -1, -1), kernels)


def convolve_padded(padded: Tensor, kernels: Tensor) -> Tensor:
    """The same for pictures (B, C, H + S - 1, W + S - 1) that have their edges already."""
    batch, channels, height, width = padded.shape
    count, size = kernels.shape[1], kernels.shape[-1]
    pictures = 1 if padded.stride(0) == 0 else batch  # expanded from one: a plain convolution, three times as fast
    moved = F.conv2d(padded[:pictures].transpose(0, 1), kernels.flatten(0, 1).unsqueeze(1), groups=pictures)
    return moved.view(channels, batch, count, height - size + 1, width - size + 1).permute(1, 2, 0, 3, 4)


def advect(picture: Tensor, masks: Tensor, kernels: Tensor) -> Tensor:
    """Move a picture by K kernels and blend what comes of it by masks, edges repeated.

    Args:
        picture: (B, C, H, W) float32.
        masks: (B, K, H, W).
        kernels: (B, K, S, S), S odd; entry (i, j) is the weight of the pixel i - S // 2 rows down and j - S // 2
            columns to the right.

    Returns:
        (B, C, H, W), the sum over k of mask_k times the picture convolved with kernel_k.
    """
    size = kernels.shape[-1]
    padded = F.pad(picture, (size // 2,) * 4, mode="replicate")
    if torch.is_grad_enabled() and any(x.requires_grad for x in (padded, masks, kernels)):
        weights = torch.bmm(kernels.flatten(2).mT, masks.flatten(2)).unflatten(2, picture.shape[-2:])
        return _PixelKernels.apply(padded, weights)
    return torch.einsum("bkhw,bkchw->bchw", masks, convolve(picture, kernels))


class _PixelKernels(torch.autograd.Function):
    """A kernel of its own for every pixel: padded picture (B, C, H+S-1, W+S-1), weights (B, S*S, H, W)."""

    @staticmethod
    def forward(ctx: Any, padded: Tensor, weights: Tensor) -> Tensor:
        ctx.save_for_backward(padded, weights)
        size, height, width = _sizes(padded, weights)
        out = padded.new_zeros((*padded.shape[:2], height, width))
        for i in range(size):
            out = _add_row(out, padded[:, :, i : i + height].contiguous(), weights[:, i * size : (i + 1) * size])
        return out

    @staticmethod
    def backward(ctx: Any, *gradients: Tensor) -> tuple[Tensor | None, Tensor]:
        padded, weights = ctx.saved_tensors
        gradient = gradients[0].contiguous()
        size, height, _ = _sizes(padded, weights)
        of_weights = torch.empty_like(weights)
        of_padded = torch.zeros_like(padded) if ctx.needs_input_grad[0] else None
        for i in range(size):
            row = slice(i * size, (i + 1) * size)
            of_weights[:, row] = _row_of_weights(gradient, padded[:, :, i : i + height].contiguous(), size)
            if of_padded is not None:
                of_padded[:, :, i : i + height] += _row_of_picture(gradient, weights[:, row], size)
        return of_padded, of_weights


def _sizes(padded: Tensor, weights: Tensor) -> tuple[int, int, int]:
    height, width = weights.shape[-2:]
    return padded.shape[-1] - width + 1, height, width


@compiled
def _add_row(out: Tensor, rows: Tensor, weights: Tensor) -> Tensor:
    """One row of all kernels: its S shifts added up."""
    width = out.shape[-1]
    for j in range(weights.shape[1]):
        out = out + weights[:, j : j + 1] * rows[..., j : j + width]
    return out


@compiled
def _row_of_weights(gradient: Tensor, rows: Tensor, size: int) -> Tensor:
    width = gradient.shape[-1]
    columns = []
    for j in range(size):
        shift = gradient * rows[..., j : j + width]
        total = shift[:, 0]
        for channel in range(1, shift.shape[1]):
            total = total + shift[:, channel]
        columns.append(total)
    return torch.stack(columns, dim=1)


@compiled
def _row_of_picture(gradient: Tensor, weights: Tensor, size: int) -> Tensor:
    width = gradient.shape[-1]
    gradient = F.pad(gradient, (size - 1, size - 1))
    weights = F.pad(weights, (size - 1, size - 1))
    total = gradient.new_zeros((*gradient.shape[:-1], width + size - 1))
    for j in range(size):
        view = slice(size - 1 - j, 2 * size - 2 - j + width)
        total = total + weights[:, j : j + 1, :, view] * gradient[..., view]
    return total
