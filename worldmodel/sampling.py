"""Many futures of one clip from latents of the prior, and the best of them."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
import torch
from torch import Tensor

from worldmodel.clips import Clips
from worldmodel.metrics import squared_error
from worldmodel.perceptual import PerceptualNetwork
from worldmodel.t3vip import CloudPrediction
from worldmodel.world_model import WorldModel

Selection = Literal["vgg", "psnr"]
SHORTLIST = 5
"""Of the samples ranked by VGG in reduced precision, so many are ranked again in float32."""


@dataclass(frozen=True)
class Futures:
    """N predictions of the P frames after the context of one clip."""

    rgb: Tensor
    """(N, P, 3, H, W)."""
    depth: Tensor | None
    """(N, P, 1, H, W) metres; None of a model of pictures."""
    inpainted: Tensor | None
    """(N, P) share of pixels; None of a model of pictures."""

    def pick(self, index: int) -> Futures:
        """One of them, as a batch of one."""
        chosen = slice(index, index + 1)
        return Futures(
            self.rgb[chosen],
            None if self.depth is None else self.depth[chosen],
            None if self.inpainted is None else self.inpainted[chosen],
        )


def draw_latents(model: WorldModel, samples: int, steps: int, seed: tuple[int, ...]) -> Tensor:
    """Latents from the prior N(0, I), (samples, steps, Z, H/8, W/8) on the model's device.

    The same seed gives the same latents to every model of one picture size; a model with one latent a clip gets the
    first step's at every step.
    """
    mixed = np.random.SeedSequence(seed).generate_state(1, np.uint64)[0]
    noise = torch.Generator().manual_seed(int(mixed) >> 1)
    latents = torch.randn((samples, steps, *model.latent_shape), generator=noise)
    if model.config.latents == "clip":
        latents = latents[:, :1].expand_as(latents)
    return latents.to(model.device)


def predict_futures(model: WorldModel, clip: Clips, context: int, latents: Tensor) -> Futures:
    """Free-running predictions of one clip, one for each row of latents; the context is encoded once, for all.

    Args:
        clip: a batch of one on the model's device.
        context: frames that the model sees, with latents at 0.
        latents: (N, P, Z, H/8, W/8), for the P frames after the context.
    """
    state = model.observe(clip.rgb[:, :context], clip.depth[:, :context], clip.actions[:, : context - 1])
    rgb, depth, inpainted = [], [], []
    for t in range(latents.shape[1]):
        state, prediction = model.step(state, clip.actions[:, context - 1 + t], latents[:, t])
        rgb.append(prediction.rgb)
        if isinstance(prediction, CloudPrediction):
            depth.append(prediction.depth)
            inpainted.append(prediction.occlusion.mean((1, 2, 3)))
    if not depth:
        return Futures(torch.stack(rgb, dim=1), None, None)
    return Futures(torch.stack(rgb, dim=1), torch.stack(depth, dim=1), torch.stack(inpainted, dim=1))


def best_future(futures: Futures, truth: Tensor, networks: tuple[PerceptualNetwork, PerceptualNetwork] | None) -> int:
    """Which of the futures is nearest to the truth, over all predicted frames together.

    Args:
        futures: of one clip.
        truth: (1, P, 3, H, W), the true frames.
        networks: to choose by VGG (lowest mean LPIPS): one that ranks all of the samples, as fast as the machine can,
            and one in float32 that decides among the first of them. None to choose by PSNR (lowest mean squared error).
    """
    if networks is None:
        return int(squared_error(futures.rgb.clamp(0, 1), truth).mean(1).argmin())
    ranking, deciding = networks
    if ranking is deciding:
        return int(_mean_lpips(deciding, futures.rgb, truth).argmin())
    first = _mean_lpips(ranking, futures.rgb, truth).topk(min(SHORTLIST, len(futures.rgb)), largest=False).indices
    return int(first[_mean_lpips(deciding, futures.rgb[first], truth).argmin()])


def _mean_lpips(network: PerceptualNetwork, rgb: Tensor, truth: Tensor) -> Tensor:
    """(N, P, 3, H, W) against (1, P, 3, H, W) to (N,)."""
    return torch.stack([network(rgb[:, t], truth[:, t])[0] for t in range(rgb.shape[1])]).mean(0)
