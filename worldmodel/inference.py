"""The inference network q(z | x_0:T), used in training and to be measured, never to predict (paper, III-C)."""

from __future__ import annotations

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from worldmodel.blocks import layer_norm
from worldmodel.config import Evidence
from worldmodel.trunk import scaled
from worldmodel.world_model import WorldModel

CONTRAST = 4.0
"""Changes are this much enlarged: they are small beside the first convolution's bias."""
LOG_VARIANCES = (-10.0, 2.0)
"""Bounds: until the KL sets in, nothing else keeps a noise that the generator ignores from growing, and it did grow."""
FIRST_LOG_VARIANCE = -3.0
"""Of an untrained network: its means are then larger than its noise."""


class InferenceNetwork(nn.Module):
    """Mean and log variance of each latent from the whole RGB-D clip.

    SV2P's tower (conv 3x3/2 32, 3x3/2 64, 3x3 64, 3x3/2 to mean and log variance), with two changes. SV2P stacks all
    frames on the channels and so fits one clip length only; here each frame passes the tower's first half alone and a
    latent sees the frame before and after it and the mean over the clip, so that a clip of any length will do. And it
    sees how frames differ from the clip's mean (see `ModelConfig.inferred_from`).
    """

    def __init__(
        self, frame_channels: int, latent_channels: int, width: float, per_clip: bool, evidence: Evidence = "changes"
    ) -> None:
        super().__init__()
        small, middle = scaled(32, width), scaled(64, width)
        self.per_clip, self.evidence = per_clip, evidence
        self.conv0 = nn.Conv2d(frame_channels, small, 3, stride=2, padding=1)
        self.conv1 = nn.Conv2d(small, middle, 3, stride=2, padding=1)
        self.norm0, self.norm1, self.norm2 = layer_norm(small), layer_norm(middle), layer_norm(middle)
        self.conv2 = nn.Conv2d(3 * middle, middle, 3, padding=1)
        self.heads = nn.Conv2d(middle, 2 * latent_channels, 3, stride=2, padding=1)
        nn.init.constant_(self.heads.bias[latent_channels:], FIRST_LOG_VARIANCE)  # type: ignore[index]

    def forward(self, frames: Tensor) -> tuple[Tensor, Tensor]:
        """Infer the latents of a clip.

        Args:
            frames: (B, T, C, H, W), all scaled to about [0, 1].

        Returns:
            Mean and log variance, (B, T-1, Z, H/8, W/8) each; a latent per clip is repeated over time.
        """
        batch, length = frames.shape[:2]
        if self.evidence == "changes":
            frames = CONTRAST * (frames - frames.mean(1, keepdim=True))
        x = frames.flatten(0, 1).contiguous(memory_format=torch.channels_last)
        x = self.norm0(F.relu(self.conv0(x)))
        x = self.norm1(F.relu(self.conv1(x))).unflatten(0, (batch, length))
        whole = x.mean(1, keepdim=True).expand(-1, length - 1, -1, -1, -1)
        if self.per_clip:
            around = torch.cat((whole, x[:, :1].expand_as(whole), x[:, -1:].expand_as(whole)), dim=2)
        else:
            around = torch.cat((whole, x[:, :-1], x[:, 1:]), dim=2)
        x = self.norm2(F.relu(self.conv2(around.flatten(0, 1))))
        mean, log_variance = self.heads(x).float().unflatten(0, (batch, length - 1)).chunk(2, dim=2)
        return mean, log_variance.clamp(*LOG_VARIANCES)


def inference_network(model: WorldModel) -> InferenceNetwork:
    """A fresh inference network for a model with latents, on the CPU."""
    config = model.config
    return InferenceNetwork(
        model.frame_channels, model.latent_channels, config.width, config.latents == "clip", config.inferred_from
    )
