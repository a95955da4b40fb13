"""What a model's latents carry: how far the inference network leaves the prior, and in how many units."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

from worldmodel.clips import Clips
from worldmodel.inference import InferenceNetwork
from worldmodel.world_model import WorldModel

ACTIVE_VARIANCE = 0.01
"""A unit whose posterior mean varies more than this over the data is active (Burda et al. 2016)."""


class LatentUse:
    """Gathers what the inference network says over batches of clips."""

    def __init__(self) -> None:
        self.means: list[Tensor] = []
        self.divergences: list[Tensor] = []

    def infer(self, model: WorldModel, inference: InferenceNetwork, clips: Clips) -> Tensor:
        """The mean of q(z | clip), (B, T-1, Z, H/8, W/8)."""
        with torch.autocast(model.device.type, model.precision, enabled=model.precision != torch.float32):
            mean, log_variance = inference(model.frame(clips.rgb, clips.depth))
        once = slice(0, 1) if inference.per_clip else slice(None)
        each = 0.5 * (mean.square() + log_variance.exp() - 1 - log_variance)
        self.means.append(mean[:, once].flatten(2).flatten(0, 1).double().cpu())
        self.divergences.append(each[:, once].flatten(2).sum(-1).flatten().double().cpu())
        return mean

    def summary(self) -> dict[str, Any]:
        """`units` of a latent, how many of them are `active`, and `kl_nats`: the mean KL(q || N(0, I)) of a latent."""
        means = torch.cat(self.means)
        active = means.var(0, unbiased=False) > ACTIVE_VARIANCE
        return {
            "units": means.shape[1],
            "active": int(active.sum()),
            "kl_nats": float(torch.cat(self.divergences).mean()),
        }
