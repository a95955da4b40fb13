"""What training makes small of a rollout: which terms of the objective there are, and of what each is taken."""

from __future__ import annotations

from torch import Tensor

from worldmodel import losses
from worldmodel.clips import Clips
from worldmodel.rollout import Rollout
from worldmodel.t3vip import T3VIP
from worldmodel.world_model import WorldModel


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
