"""T3VIP (section III of the paper): masks and rigid motions move a point cloud, splatting and inpainting render it.

Where this departs from the paper or from its public code, and why:
- Recurrent state is carried from frame to frame (the public code drops it).
- Each rotation turns about the centroid of its mask instead of the camera origin: metres away, a turn about the
  origin throws points so far that rotation and translation fight each other.
- The action enters the head of the transforms as well as the trunk, so that "the hand goes where it is told" is a
  linear map that is learned in minutes.
- Points that leave the picture or lie behind the camera are dropped, not clamped to the border.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor, nn
from torch.nn import functional as F

from envs.camera import CameraModel
from envs.errors import UsageError
from worldmodel import geometry
from worldmodel.blocks import LSTMState
from worldmodel.config import ModelConfig, ModelContext
from worldmodel.splatting import MIN_COVERAGE, splat
from worldmodel.trunk import STRIDE, Decoder, Encoder, scaled

Memory = list[LSTMState]


def expand(x: Tensor, count: int) -> Tensor:
    """A batch of one as a batch of `count`, without copying."""
    return x.expand(count, *x.shape[1:])


@dataclass(frozen=True)
class Prediction:
    """One predicted frame and what it was made of; float32, metres and pixels, camera frame."""

    rgb: Tensor
    """(B, 3, H, W) in [0, 1]."""
    depth: Tensor
    """(B, 1, H, W) metres."""
    masks: Tensor
    """(B, K, H, W), sums to 1; mask 0 is the background."""
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


@dataclass(frozen=True)
class WorldState:
    """What a model knows: the current frame, seen or predicted, and its memory."""

    rgb: Tensor
    depth: Tensor
    memory: Memory

    def expand(self, count: int) -> WorldState:
        """The same state `count` times over, for that many candidate futures; the batch must be 1."""

        memory = [(expand(hidden, count), expand(cell, count)) for hidden, cell in self.memory]
        return WorldState(expand(self.rgb, count), expand(self.depth, count), memory)


class TransformHead(nn.Module):
    """Motion embedding and action to K - 1 rigid transforms, the identity at initialisation."""

    identity: Tensor

    def __init__(self, inputs: int, action_dim: int, count: int, width: float) -> None:
        super().__init__()
        wide, narrow = scaled(256, width), scaled(128, width)
        self.first = nn.Linear(inputs, wide)
        self.second = nn.Linear(wide + action_dim, narrow)
        self.last = nn.Linear(narrow + action_dim, 9 * count)
        nn.init.uniform_(self.last.weight, -1e-4, 1e-4)
        nn.init.zeros_(self.last.bias)
        self.register_buffer("identity", torch.tensor([1.0, 0, 0, 0, 1.0, 0]), persistent=False)

    def forward(self, embedding: Tensor, action: Tensor) -> tuple[Tensor, Tensor]:
        """Returns rotations (B, K-1, 3, 3) and translations (B, K-1, 3) in metres, float32."""
        x = F.relu(self.first(embedding.flatten(1)))
        x = F.relu(self.second(torch.cat((x, action.to(x.dtype)), dim=1)))
        # The last layer is tiny and decides on millimetres: always in float32.
        with torch.autocast(x.device.type, enabled=False):
            x = self.last(torch.cat((x.float(), action.float()), dim=1)).unflatten(1, (-1, 9))
            return geometry.rotation_from_6d(x[..., 3:] + self.identity), x[..., :3]


class T3VIP(nn.Module):
    """The generator G of the paper. Speak to it with `observe` and `step`; training calls `predict`."""

    intrinsics: Tensor
    rays: Tensor
    grid: Tensor
    action_mean: Tensor
    action_std: Tensor

    def __init__(self, config: ModelConfig, context: ModelContext) -> None:
        super().__init__()
        self.config, self.context = config, context
        self.precision = torch.float32
        """What the network runs in; geometry and splatting always run in float32."""
        self.camera = CameraModel.from_json(context.camera)
        height, width = self.camera.height, self.camera.width
        if height % STRIDE or width % STRIDE:
            raise UsageError(
                f"image size {height}x{width} is no multiple of {STRIDE}; collect pictures whose sides are"
            )
        self.action_dim = context.action_dim if config.act_cond else 0
        self.latent_channels = 0 if config.latents == "none" else 1
        self.encoder = Encoder(4, self.action_dim, self.latent_channels, config.width, config.lstm_kernel)
        self.mask_decoder = Decoder(config.masks, config.width, config.lstm_kernel)
        self.inpainter = Decoder(4, config.width, config.lstm_kernel)
        cells = (height // STRIDE) * (width // STRIDE)
        embedding = self.encoder.channels[-1] * cells
        self.transforms = TransformHead(embedding, self.action_dim, config.masks - 1, config.width)
        nn.init.normal_(self.mask_decoder.head.weight, std=config.mask_head_std)

        intrinsics = torch.from_numpy(np.array(self.camera.K)).float()
        self.register_buffer("intrinsics", intrinsics, persistent=False)
        self.register_buffer("rays", geometry.pixel_rays(intrinsics, height, width), persistent=False)
        self.register_buffer("grid", geometry.pixel_grid(height, width), persistent=False)
        self.register_buffer("action_mean", torch.tensor(context.action_mean), persistent=False)
        self.register_buffer("action_std", torch.tensor(context.action_std), persistent=False)

    @property
    def device(self) -> torch.device:
        """Where the model runs."""
        return self.rays.device

    @property
    def frame_gap(self) -> int:
        """Control steps from one frame to the next."""
        return self.context.frame_gap

    @property
    def latent_shape(self) -> tuple[int, int, int]:
        """(Z, H/8, W/8) of one latent; Z is 0 for a deterministic model."""
        return (self.latent_channels, self.camera.height // STRIDE, self.camera.width // STRIDE)

    def observe(self, rgb: Tensor, depth: Tensor, actions: Tensor | None = None) -> WorldState:
        """Take in context frames, `frame_gap` control steps apart.

        Args:
            rgb: (B, T, 3, H, W) in [0, 1].
            depth: (B, T, 1, H, W) metres.
            actions: (B, T-1, A), the aggregated action between each frame and the next.

        Returns:
            The state at the last frame.
        """
        memory = self.blank_memory(rgb[:, 0])
        for t in range(rgb.shape[1] - 1):
            action = None if actions is None else actions[:, t]
            _, memory = self.predict(rgb[:, t], depth[:, t], action, None, memory)
        return WorldState(rgb[:, -1].float(), depth[:, -1].float(), memory)

    def step(
        self, state: WorldState, action: Tensor | None, latent: Tensor | None = None, paint: bool = True
    ) -> tuple[WorldState, Prediction]:
        """Go one frame onward.

        Args:
            state: of a batch of B, or of 1 from which all actions start.
            action: (B, A) in the dataset's units.
            latent: (B, Z, H/8, W/8), zeros when None.
            paint: see `predict`.
        """
        prediction, memory = self.predict(state.rgb, state.depth, action, latent, state.memory, paint=paint)
        return WorldState(prediction.rgb, prediction.depth, memory), prediction

    def predict(
        self,
        rgb: Tensor,
        depth: Tensor,
        action: Tensor | None,
        latent: Tensor | None,
        memory: Memory,
        still: bool = False,
        paint: bool = True,
    ) -> tuple[Prediction, Memory]:
        """One frame, one action and a latent to the next frame.

        Args:
            rgb: (B, 3, H, W) in [0, 1].
            depth: (B, 1, H, W) metres.
            action: (B, A), aggregated over the frame gap; ignored by an action-free model.
            latent: (B, Z, H/8, W/8); zeros when None.
            memory: of the last step, or `blank_memory` at the start.
            still: replace every transform by the identity, to see what is left without motion.
            paint: run the inpainter. Without it disoccluded pixels keep what was there before, and its memory stands
                still; a third less work, for planners that look a few frames ahead.

        Returns:
            The prediction and the new memory.
        """
        batch = rgb.shape[0] if action is None else max(rgb.shape[0], action.shape[0])
        near, far = self.camera.near, self.camera.far
        frame = torch.cat((rgb, (depth - near) / (far - near)), dim=1).contiguous(memory_format=torch.channels_last)
        if self.action_dim == 0 or action is None:
            action = rgb.new_zeros((batch, self.action_dim))
        else:
            action = (action - self.action_mean) / self.action_std
        if self.latent_channels and latent is None:
            latent = rgb.new_zeros((batch, *self.latent_shape))

        device = rgb.device.type
        with torch.autocast(device, self.precision, enabled=self.precision != torch.float32):
            logits, painted, rotation, translation, memory = self.network(frame, action, latent, memory, paint)
        if still:
            rotation, translation = torch.eye(3, device=rgb.device).expand_as(rotation), torch.zeros_like(translation)
        with torch.autocast(device, enabled=False):
            masks = torch.softmax(logits.float(), dim=1)
            rgb, depth = expand(rgb.float(), batch), expand(depth.float(), batch)
            prediction = self._render(rgb, depth, masks, rotation, translation, painted)
        return prediction, memory

    def network(
        self, frame: Tensor, action: Tensor, latent: Tensor | None, memory: Memory, paint: bool
    ) -> tuple[Tensor, Tensor | None, Tensor, Tensor, Memory]:
        """All that is learned: scaled RGB-D frame and normalised action to mask logits, painted RGB-D logits, and the
        rotations and translations of the moving masks."""
        features, skips, seen = self.encoder.look(frame, memory[:4])
        if len(action) > len(frame):  # one past, many futures: what was seen is encoded once
            count = len(action)
            features, skips = expand(features, count), (expand(skips[0], count), expand(skips[1], count))
            seen = [(expand(hidden, count), expand(cell, count)) for hidden, cell in seen]
            memory = [(expand(hidden, count), expand(cell, count)) for hidden, cell in memory]
        embedding, acted = self.encoder.act(features, action, latent, memory[4])
        logits, mask_memory = self.mask_decoder(embedding, skips, memory[5:7])
        painted, paint_memory = self.inpainter(embedding, skips, memory[7:9]) if paint else (None, memory[7:9])
        rotation, translation = self.transforms(embedding, action)
        return logits, painted, rotation, translation, [*seen, acted, *mask_memory, *paint_memory]

    def blank_memory(self, like: Tensor) -> Memory:
        """Zero states for a batch of frames `like` (B, ..., H, W), in the precision that the network runs in."""
        small, middle, large = self.encoder.channels
        layout = [(small, 2), (small, 2), (middle, 4), (middle, 4), (large, 8)] + 2 * [(middle, 4), (small, 2)]
        memory = []
        for channels, stride in layout:
            shape = (like.shape[0], channels, self.camera.height // stride, self.camera.width // stride)
            cell = torch.zeros(shape, device=like.device).contiguous(memory_format=torch.channels_last)
            memory.append((cell.to(self.precision), cell))
        return memory

    def _render(
        self, rgb: Tensor, depth: Tensor, masks: Tensor, rotation: Tensor, translation: Tensor, painted: Tensor | None
    ) -> Prediction:
        """Transformation layer, splatting layer and RGB-D generator: Eqs. (1) to (5) of the paper."""
        points = geometry.unproject(depth, self.rays)
        pivots = geometry.mask_centroids(masks[:, 1:], points).detach()
        moving = geometry.rotate_about(rotation, translation, pivots)
        still = torch.eye(3, 4, device=rgb.device).expand(rgb.shape[0], 1, 3, 4)
        transform = geometry.blend_transforms(masks, torch.cat((still, moving), dim=1))
        moved = geometry.apply_transforms(transform, points)
        pixels = geometry.project(moved, self.intrinsics)
        moved_depth = moved[:, 2:]
        warped, coverage = splat(
            torch.cat((rgb, moved_depth), dim=1), pixels, moved_depth, self.config.splat, self.config.splat_sharpness
        )
        occlusion = (coverage < MIN_COVERAGE).float()
        near, far = self.camera.near, self.camera.far
        if painted is None:
            painted_rgb, painted_depth = rgb, depth
        else:
            painted = torch.sigmoid(painted.float())
            painted_rgb, painted_depth = painted[:, :3], near + (far - near) * painted[:, 3:]
        return Prediction(
            rgb=warped[:, :3] * (1 - occlusion) + painted_rgb * occlusion,
            depth=warped[:, 3:].clamp(near, far) * (1 - occlusion) + painted_depth * occlusion,
            masks=masks,
            points=points,
            transform=transform,
            scene_flow=moved - points,
            optical_flow=pixels - self.grid,
            occlusion=occlusion,
        )
