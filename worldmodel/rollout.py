"""Unrolling a model over a clip, on true frames, on its own, or on a mixture of both."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from worldmodel.clips import Clips
from worldmodel.world_model import Prediction, WorldModel


@dataclass(frozen=True)
class Rollout:
    """Predictions of frames 1 .. T-1 of a clip and the frames they were made from."""

    predictions: Sequence[Prediction]
    input_rgb: Tensor
    """(B, T-1, 3, H, W)."""

    def stack(self, name: str) -> Tensor:
        """One field of all predictions, (B, T-1, ...)."""
        return torch.stack([getattr(prediction, name) for prediction in self.predictions], dim=1)


def unroll(
    model: WorldModel,
    clips: Clips,
    context: int,
    latents: Tensor | None = None,
    truth: float | Tensor = 0.0,
    coins: Tensor | None = None,
    still: bool = False,
) -> Rollout:
    """Predict every next frame of a clip.

    Args:
        model: the world model.
        clips: the clip, T frames; with `truth` 0 only its first `context` frames and its actions are looked at.
        context: frames that are always true.
        latents: (B, T-1, Z, H/8, W/8), or None for zeros.
        truth: probability that a later input is the true frame instead of the predicted one (scheduled sampling); a
            tensor () where it changes from call to call of one recorded program.
        coins: (B, T-1) drawn from [0, 1): where a coin is below `truth`, the frame that it leads to stays true. Needed
            where `truth` is neither 0 nor 1.
        still: let nothing move.
    """
    rgb, depth = clips.rgb[:, 0], clips.depth[:, 0]
    memory = model.blank_memory(rgb)
    predictions: list[Prediction] = []
    inputs = []
    always, never = (False, False) if isinstance(truth, Tensor) else (truth >= 1, truth <= 0)
    with model.lending():
        for t in range(clips.actions.shape[1]):
            inputs.append(rgb)
            latent = None if latents is None else latents[:, t]
            prediction, memory = model.predict(rgb, depth, clips.actions[:, t], latent, memory, still=still)
            predictions.append(prediction)
            predicted_depth = depth if prediction.depth is None else prediction.depth
            if t + 1 < context or always:
                rgb, depth = clips.rgb[:, t + 1], clips.depth[:, t + 1]
            elif never:
                rgb, depth = prediction.rgb, predicted_depth
            else:
                assert coins is not None
                true = (coins[:, t] < truth).view(-1, 1, 1, 1)
                rgb = torch.where(true, clips.rgb[:, t + 1], prediction.rgb)
                depth = torch.where(true, clips.depth[:, t + 1], predicted_depth)
    return Rollout(predictions, torch.stack(inputs, dim=1))
