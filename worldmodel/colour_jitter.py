"""Changing each clip's colours as a whole, lest a model cling to those of its scene; depth stays."""

from __future__ import annotations

from dataclasses import dataclass, fields

import numpy as np
import torch
from torch import Tensor

from worldmodel.clips import Clips


@dataclass(frozen=True)
class ColourJitter:
    """What happens to the colours of each clip of a batch."""

    order: Tensor
    """(B, 3) int64, of the channels."""
    gamma: Tensor
    """(B, 1, 1, 1, 1), exponent."""
    gain: Tensor
    """(B, 1, 3, 1, 1)."""
    offset: Tensor
    """(B, 1, 1, 1, 1)."""

    @staticmethod
    def draw(batch: int, strength: float, rng: np.random.Generator) -> ColourJitter:
        """Draw for a batch of clips; with strength 0 nothing will change but the order of the channels."""

        def uniform(channels: int) -> Tensor:
            return torch.from_numpy(rng.uniform(-strength, strength, (batch, 1, channels, 1, 1))).float()

        order = torch.from_numpy(np.stack([rng.permutation(3) for _ in range(batch)]))
        return ColourJitter(order, torch.exp(uniform(1)), 1 + uniform(3), 0.5 * uniform(1))

    def share(self, part: slice) -> ColourJitter:
        """Of some of the clips only."""
        return ColourJitter(*(getattr(self, field.name)[part] for field in fields(self)))

    def apply(self, clips: Clips) -> Clips:
        """The clips with other colours, on the device that they are on."""
        device, batch = clips.rgb.device, clips.rgb.shape[0]
        order, gamma, gain, offset = (getattr(self, field.name).to(device) for field in fields(self))
        picture = torch.gather(clips.rgb, 2, order.view(batch, 1, 3, 1, 1).expand_as(clips.rgb))
        picture = picture.clamp(min=1e-4) ** gamma * gain + offset
        return Clips(picture.clamp(0, 1), clips.depth, clips.actions)
