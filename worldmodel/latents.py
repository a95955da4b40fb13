"""What a model's latents carry: how far the inference network leaves the prior, and in how many units."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

from worldmodel.clips import Clips
from worldmodel.inference import InferenceNetwork
from worldmodel.losses import divergence
from worldmodel.scores import Statistics
from worldmodel.world_model import WorldModel

ACTIVE_VARIANCE = 0.01
"""A unit whose posterior mean varies more than this over the data is active (Burda et al. 2016)."""


def infer_latents(model: WorldModel, inference: InferenceNetwork, clips: Clips) -> tuple[Tensor, Statistics]:
    """The means of q(z | clip), and what `latent_use` is to know of them.

    Returns:
        (B, T-1, Z, H/8, W/8); and by latent, of which each clip has T - 1 or a single one, its `means` (latents,
        units) and its `divergence` (latents,) from the prior in nats.
    """
    with torch.autocast(model.device.type, model.precision, enabled=model.precision != torch.float32):
        mean, log_variance = inference(model.frame(clips.rgb, clips.depth))
    once = slice(0, 1) if inference.per_clip else slice(None)
    of_each = divergence(mean, log_variance)[:, once].flatten(2).sum(-1).flatten()
    return mean, {"means": mean[:, once].flatten(2).flatten(0, 1), "divergence": of_each}


def latent_use(inferred: Statistics) -> dict[str, Any]:
    """What latents carry, by all that `infer_latents` said of them.

    Returns:
        `units` of a latent, how many of them are `active`, and `kl_nats`: the mean KL(q || N(0, I)) of a latent.
    """
    means = inferred["means"]
    active = means.var(0, unbiased=False) > ACTIVE_VARIANCE
    return {
        "units": means.shape[1],
        "active": int(active.sum()),
        "kl_nats": float(inferred["divergence"].mean()),
    }
