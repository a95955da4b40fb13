"""T3VIP (section III of the paper): masks and rigid motions move a point cloud, splatting and inpainting render it.

Where this departs from the paper or from its public code, and why:
- Recurrent state is carried from frame to frame (the public code drops it).
- Each rotation turns about the centroid of its mask instead of the camera origin: metres away, a turn about the
  origin throws points so far that rotation and translation fight each other.
- The action enters the head of the transforms as well as the trunk, so that "the hand goes where it is told" is a
  linear map that is learned in minutes.
- Translations are learned in units of some pixels, lest a step of Adam move things by many of them.
- Points that leave the picture or lie behind the camera are dropped, not clamped to the border.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor, nn
from torch.nn import functional as F

from worldmodel import geometry
from worldmodel.blocks import LSTMState, PreciseLinear
from worldmodel.config import ModelConfig, ModelContext
from worldmodel.splatting import MIN_COVERAGE, splat
from worldmodel.trunk import Decoder, scaled
from worldmodel.world_model import Prediction, WorldModel


@dataclass(frozen=True)
class CloudPrediction(Prediction):
    """What T3VIP predicts, metres and pixels, camera frame; mask 0 is the background."""

    depth: Tensor
    """(B, 1, H, W) metres."""
    points: Tensor
    """(B, 3, H, W), the cloud before the move."""
    transform: Tensor
    """(B, 3, 4, H, W), the blended transform that moves each pixel's point."""
    scene_flow: Tensor
    """(B, 3, H, W) metres."""
    optical_flow: Tensor
    """(B, 2, H, W) pixels."""
    occlusion: Tensor
    """(B, 1, H, W), 1 where no point lands and the inpainter paints."""

    @property
    def moved_points(self) -> Tensor:
        """(B, 3, H, W), the cloud after the move, still in the order of the pixels it came from."""
        return self.points + self.scene_flow


class TransformHead(nn.Module):
    """Motion embedding and action to K - 1 rigid transforms.

    At initialisation none of them turns and, up to a hundredth of a pixel, none shifts; with `shift`, each is shifted
    by the action in a direction of its own.

    Args:
        inputs: numbers in a motion embedding.
        action_dim: numbers in an action; without any, `shift` makes each start with one that is always the same.
        count: of transforms.
        width: multiplier on the channels.
        unit: what a translation of 1 is in the last layer, metres.
        shift: standard deviation of the first shifts along each axis, under actions as they usually are, in this unit.
    """

    identity: Tensor

    def __init__(self, inputs: int, action_dim: int, count: int, width: float, unit: float, shift: float) -> None:
        super().__init__()
        self.unit = unit
        wide, narrow = scaled(256, width), scaled(128, width)
        self.first = nn.Linear(inputs, wide)
        self.second = nn.Linear(wide + action_dim, narrow)
        self.last = PreciseLinear(narrow + action_dim, 9 * count)
        nn.init.uniform_(self.last.weight, -1e-4, 1e-4)
        nn.init.zeros_(self.last.bias)
        if shift:
            by_action, always = self.last.weight.data[:, narrow:], self.last.bias.data[:, None]
            shifts = (by_action if action_dim else always).unflatten(0, (count, 9))[:, :3]
            shifts.normal_(0.0, shift / max(1, action_dim) ** 0.5)
        self.register_buffer("identity", torch.tensor([1.0, 0, 0, 0, 1.0, 0]), persistent=False)

    def forward(self, embedding: Tensor, action: Tensor) -> tuple[Tensor, Tensor]:
        """Returns rotations (B, K-1, 3, 3) and translations (B, K-1, 3) in metres, float32."""
        x = F.relu(self.first(embedding.flatten(1)))
        x = F.relu(self.second(torch.cat((x, action.to(x.dtype)), dim=1)))
        x = self.last(torch.cat((x.float(), action.float()), dim=1)).unflatten(1, (-1, 9))  # it decides on millimetres
        with torch.autocast(x.device.type, enabled=False):
            return geometry.rotation_from_6d(x[..., 3:] + self.identity), self.unit * x[..., :3]


class Heads(NamedTuple):
    """What the network says about the next frame."""

    logits: Tensor
    """(B, K, H, W) of the masks."""
    painted: Tensor | None
    """(B, 4, H, W) logits of the inpainted RGB-D, or None when nothing was painted."""
    rotation: Tensor
    """(B, K-1, 3, 3)."""
    translation: Tensor
    """(B, K-1, 3) metres."""


class T3VIP(WorldModel):
    """The generator G of the paper: an RGB-D frame moves by K - 1 rigid transforms."""

    kind = "t3vip"
    frame_channels = 4
    decoders = 2

    intrinsics: Tensor
    rays: Tensor
    grid: Tensor

    def __init__(self, config: ModelConfig, context: ModelContext) -> None:
        super().__init__(config, context)
        height, width = self.camera.height, self.camera.width
        self.mask_decoder = Decoder(config.masks, config)
        self.inpainter = Decoder(4, config)
        pixel = (self.camera.near + self.camera.far) / 2 / float(self.camera.K[0, 0])  # metres, half way to the back
        unit, shift = config.translation_unit * pixel, config.first_shift / config.translation_unit
        self.transforms = TransformHead(
            self.embedding_size, self.action_dim, config.masks - 1, config.width, unit, shift
        )
        nn.init.normal_(self.mask_decoder.head.weight, std=config.mask_head_std)

        intrinsics = torch.from_numpy(np.array(self.camera.K)).float()
        self.register_buffer("intrinsics", intrinsics, persistent=False)
        self.register_buffer("rays", geometry.pixel_rays(intrinsics, height, width), persistent=False)
        self.register_buffer("grid", geometry.pixel_grid(height, width), persistent=False)

    def network(
        self, frame: Tensor, action: Tensor, latent: Tensor | None, states: list[LSTMState], paint: bool
    ) -> tuple[Heads, list[LSTMState]]:
        embedding, skips, seen, states = self.embed(frame, action, latent, states)
        logits, mask_states = self.mask_decoder(embedding, skips, states[:2])
        painted, paint_states = self.inpainter(embedding, skips, states[2:]) if paint else (None, states[2:])
        rotation, translation = self.transforms(embedding, action)
        return Heads(logits, painted, rotation, translation), [*seen, *mask_states, *paint_states]

    def render(
        self, rgb: Tensor, depth: Tensor, heads: Heads, first: Tensor | None, still: bool, picture: bool = True
    ) -> CloudPrediction:
        """Transformation layer, splatting layer and RGB-D generator: Eqs. (1) to (5) of the paper."""
        rotation, translation = heads.rotation, heads.translation
        if still:
            rotation, translation = torch.eye(3, device=rgb.device).expand_as(rotation), torch.zeros_like(translation)
        masks = torch.softmax(heads.logits.float(), dim=1)
        points = geometry.unproject(depth, self.rays)
        pivots = geometry.mask_centroids(masks[:, 1:], points).detach()
        moving = geometry.rotate_about(rotation, translation, pivots)
        background = torch.eye(3, 4, device=rgb.device).expand(rgb.shape[0], 1, 3, 4)
        transform = geometry.blend_transforms(masks, torch.cat((background, moving), dim=1))
        moved = geometry.apply_transforms(transform, points)
        pixels = geometry.project(moved, self.intrinsics)
        flows = {"points": points, "transform": transform, "scene_flow": moved - points}
        flows["optical_flow"] = pixels - self.grid
        if not picture:
            return CloudPrediction(rgb=rgb, depth=depth, masks=masks, occlusion=torch.zeros_like(depth), **flows)
        moved_depth = moved[:, 2:]
        warped, coverage = splat(
            torch.cat((rgb, moved_depth), dim=1), pixels, moved_depth, self.config.splat, self.config.splat_sharpness
        )
        occlusion = (coverage < MIN_COVERAGE).float()
        near, far = self.camera.near, self.camera.far
        if heads.painted is None:
            painted_rgb, painted_depth = rgb, depth
        else:
            painted = torch.sigmoid(heads.painted.float())
            painted_rgb, painted_depth = painted[:, :3], near + (far - near) * painted[:, 3:]
        return CloudPrediction(
            rgb=warped[:, :3] * (1 - occlusion) + painted_rgb * occlusion,
            depth=warped[:, 3:].clamp(near, far) * (1 - occlusion) + painted_depth * occlusion,
            masks=masks,
            occlusion=occlusion,
            **flows,
        )
