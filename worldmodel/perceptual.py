"""Likeness of pictures in the eyes of VGG-16: LPIPS (Zhang et al. 2018) and the cosine similarity of features."""

from __future__ import annotations

from collections.abc import Mapping

import torch
from torch import Tensor, nn
from torch.nn import functional as F

POOLED_BEFORE = (2, 4, 7, 10)
"""Convolutions in front of which the picture is halved."""
TAPPED = (1, 3, 6, 9, 12)
"""Convolutions whose output, rectified, is looked at: relu1_2, relu2_2, relu3_3, relu4_3, relu5_3."""
SMALLEST = 16
"""Pixels; a shorter side would be halved to nothing."""
_SHIFT, _SCALE = (-0.030, -0.088, -0.188), (0.458, 0.448, 0.450)  # of LPIPS, for pictures in [-1, 1]
_CHUNK = 50  # pictures at a time; their features take 100 MB in float32


class PerceptualNetwork(nn.Module):
    """VGG-16 up to relu5_3 and the linear layers of LPIPS; never trained.

    Args:
        weights: see `perceptual_weights.load_weights`.
        precision: what the convolutions run in; features are compared in float32 in any case.
    """

    shift: Tensor
    scale: Tensor

    def __init__(self, weights: Mapping[str, Tensor], precision: torch.dtype = torch.float32) -> None:
        super().__init__()
        self.precision = precision
        self.convolutions = nn.ParameterList()
        self.biases = nn.ParameterList()
        for i in range(TAPPED[-1] + 1):
            kernel = weights[f"conv{i}.weight"].to(precision).contiguous(memory_format=torch.channels_last)
            self.convolutions.append(kernel)
            self.biases.append(weights[f"conv{i}.bias"].to(precision))
        self.linear = nn.ParameterList(weights[f"linear{i}"].float() for i in range(len(TAPPED)))
        self.register_buffer("shift", torch.tensor(_SHIFT).view(3, 1, 1))
        self.register_buffer("scale", torch.tensor(_SCALE).view(3, 1, 1))
        self.requires_grad_(False)

    def features(self, pictures: Tensor) -> list[Tensor]:
        """Pictures (N, 3, H, W) in [0, 1] to five feature maps (N, C, h, w), each pixel's of length 1, float32."""
        x = (2 * pictures.clamp(0, 1) - 1 - self.shift) / self.scale
        x = x.to(self.precision).contiguous(memory_format=torch.channels_last)
        tapped = []
        for i, (kernel, bias) in enumerate(zip(self.convolutions, self.biases, strict=True)):
            if i in POOLED_BEFORE:
                x = F.max_pool2d(x, 2)
            x = F.conv2d(x, kernel, bias, padding=1).relu_()
            if i in TAPPED:
                feature = x.float()
                tapped.append(feature * (feature.square().sum(1, keepdim=True) + 1e-8).rsqrt())
        return tapped

    def forward(self, predicted: Tensor, target: Tensor) -> tuple[Tensor, Tensor]:
        """Compare pictures.

        Args:
            predicted: (N, 3, H, W), clamped to [0, 1], on any device.
            target: (N, 3, H, W), or (1, 3, H, W) for all of them.

        Returns:
            (N,) LPIPS, 0 for equal pictures: squared difference of the features, weighted by channel, averaged over
            pixels, summed over the five layers; and (N,) cosine similarity of the features, averaged over pixels and
            layers, 1 for equal pictures.
        """
        predicted, target = predicted.to(self.shift.device), target.to(self.shift.device)
        one = self.features(target) if len(target) == 1 else None
        parts = []
        for first in range(0, len(predicted), _CHUNK):
            chunk = slice(first, first + _CHUNK)
            other = self.features(target[chunk]) if one is None else one
            parts.append(self._compare(self.features(predicted[chunk]), other))
        lpips, cosine = zip(*parts, strict=True)
        return torch.cat(lpips), torch.cat(cosine)

    def _compare(self, ours: list[Tensor], theirs: list[Tensor]) -> tuple[Tensor, Tensor]:
        distances, cosines = [], []
        for feature, other, weight in zip(ours, theirs, self.linear, strict=True):
            # |a - b|^2 = 2 - 2 cos of unit vectors; where both vanish they are alike, and this says so.
            squared = (feature - other).square_().mean((2, 3))  # (N, C)
            distances.append(squared @ weight)
            cosines.append(1 - 0.5 * squared.sum(1))
        return torch.stack(distances).sum(0), torch.stack(cosines).mean(0)
