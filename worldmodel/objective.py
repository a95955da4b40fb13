"""What training makes small: the objective of a step, which terms it has, and of what each is taken."""

from __future__ import annotations

from dataclasses import asdict, dataclass

import torch
from torch import Tensor

from worldmodel import losses
from worldmodel.clips import Clips
from worldmodel.inference import InferenceNetwork
from worldmodel.options import TrainOptions
from worldmodel.rollout import Rollout, unroll
from worldmodel.t3vip import T3VIP
from worldmodel.world_model import WorldModel


@dataclass(frozen=True)
class StepInputs:
    """All that a step's objective depends on, besides the weights and the options; on the model's device."""

    rgb: Tensor
    """(B, T, 3, H, W)."""
    depth: Tensor
    """(B, T, 1, H, W) metres."""
    actions: Tensor
    """(B, T-1, A)."""
    noise: Tensor | None
    """(B, T-1, Z, H/8, W/8) from N(0, I), or (B, 1, ...) for one latent a clip; None for a model without latents."""
    coins: Tensor
    """(B, T-1) from [0, 1), for scheduled sampling."""
    truth: Tensor
    """(), the share of later inputs that are true frames."""
    kl_weight: Tensor
    """(), of the KL now."""
    inferred: bool
    """Whether latents come from the inference network by now, or still from the prior."""
    taught: bool
    """Whether any later input is a true frame."""


def objective(
    model: WorldModel, inference: InferenceNetwork | None, inputs: StepInputs, options: TrainOptions
) -> tuple[Tensor, dict[str, Tensor]]:
    """The full objective (paper, section III-F) and its unweighted terms, each the mean over the clips."""
    clips, weights = Clips(inputs.rgb, inputs.depth, inputs.actions), options.losses
    latents, kl = _latents(model, inference, inputs)
    truth = inputs.truth if inputs.taught else 0.0
    rollout = unroll(model, clips, options.context, latents, truth, inputs.coins)
    terms = reconstruction_terms(model, rollout, clips, weights)
    scale = asdict(weights)
    if kl is not None:
        terms["kl"], scale["kl"] = kl, inputs.kl_weight
    return torch.stack([scale[name] * value for name, value in terms.items()]).sum(), terms


def _latents(
    model: WorldModel, inference: InferenceNetwork | None, inputs: StepInputs
) -> tuple[Tensor | None, Tensor | None]:
    """A latent for each step, and the divergence from the prior once they are inferred."""
    if inference is None or inputs.noise is None:
        return None, None
    noise = inputs.noise.expand(-1, inputs.actions.shape[1], -1, -1, -1)
    if not inputs.inferred:
        return noise, None
    frames = model.frame(inputs.rgb, inputs.depth)
    with torch.autocast(model.device.type, model.precision, enabled=model.precision != torch.float32):
        mean, log_variance = inference(frames)
    pixels = model.camera.height * model.camera.width
    return mean + (0.5 * log_variance).exp() * noise, losses.kl_to_prior(mean, log_variance, pixels)


def reconstruction_terms(
    model: WorldModel, rollout: Rollout, clips: Clips, weights: losses.LossWeights
) -> dict[str, Tensor]:
    """All terms but the KL, over all predictions of a rollout at once; a term of weight 0 is left out.

    A model of pictures has the first of them only.
    """
    terms: dict[str, Tensor] = {}
    if weights.rgb:
        terms["rgb"] = losses.reconstruction(rollout.stack("rgb"), clips.rgb[:, 1:], weights.power)
    if not isinstance(model, T3VIP):
        return terms
    if weights.depth:
        terms["depth"] = losses.reconstruction(rollout.stack("depth"), clips.depth[:, 1:], weights.power)
    if weights.knn:
        target = clips.depth[:, 1:] * model.rays
        moved = rollout.stack("moved_points")
        terms["knn"] = losses.alignment(moved.flatten(0, 1), target.flatten(0, 1), weights)
    pictures = rollout.input_rgb.detach().flatten(0, 1)
    if weights.scene_smoothness:
        flow = rollout.stack("scene_flow").flatten(0, 1)
        terms["scene_smoothness"] = losses.edge_aware_smoothness(flow, pictures)
    if weights.optical_smoothness:
        flow = rollout.stack("optical_flow").flatten(0, 1)
        terms["optical_smoothness"] = losses.edge_aware_smoothness(flow, pictures)
    return terms
