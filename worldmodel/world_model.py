"""What all world models share: frames, actions and memory go in, the next frame and a new memory come out."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager, nullcontext
from dataclasses import dataclass
from typing import Any, ClassVar

import torch
from torch import Tensor, nn

from envs.camera import CameraModel
from envs.errors import UsageError
from worldmodel.blocks import LSTMState
from worldmodel.config import ModelConfig, ModelContext
from worldmodel.lending import WeightLoan
from worldmodel.trunk import STRIDE, Encoder, Skips

BRIGHTEST = 2.0
"""Colours beyond this are not in [0, 1], whatever noise is on them."""


def expand(x: Tensor, count: int) -> Tensor:
    """A batch of one as a batch of `count`, without copying."""
    return x.expand(count, *x.shape[1:])


@dataclass(frozen=True)
class Memory:
    """What a model carries from frame to frame."""

    states: list[LSTMState]
    """Of its ConvLSTMs: the encoder's five, then the decoders'."""
    first: Tensor | None = None
    """(B, 3, H, W), the first frame of the clip, for models that copy from it."""

    def expand(self, count: int) -> Memory:
        """The same `count` times over, without copying; the batch must be 1."""
        states = [(expand(hidden, count), expand(cell, count)) for hidden, cell in self.states]
        return Memory(states, None if self.first is None else expand(self.first, count))


@dataclass(frozen=True)
class Prediction:
    """One predicted frame and what it was made of, float32."""

    rgb: Tensor
    """(B, 3, H, W) in [0, 1]."""
    masks: Tensor
    """(B, K, H, W), sums to 1 over K."""
    depth: Tensor | None
    """(B, 1, H, W) metres; None from a model that knows pictures only."""


@dataclass(frozen=True)
class WorldState:
    """What a model knows: the current frame, seen or predicted, and its memory."""

    rgb: Tensor
    """(B, 3, H, W) in [0, 1], float32."""
    depth: Tensor
    """(B, 1, H, W) metres, float32; of a model that knows pictures only, that of the last frame seen."""
    memory: Memory


class WorldModel(nn.Module, ABC):
    """The generator of a video. Speak to it with `observe` and `step`; training calls `predict`.

    A subclass adds its heads to the shared trunk, says in `network` what is learned and in `render` how a frame is made
    of that.
    """

    kind: ClassVar[str]
    """Its name on the command line and in checkpoints."""
    frame_channels: ClassVar[int]
    """4 for a model that sees RGB-D, 3 for one that sees RGB."""
    decoders: ClassVar[int]
    """How many decoders it has on the trunk, each with two ConvLSTMs."""
    copies_first: ClassVar[bool] = False
    """Whether it copies from the first frame of the clip."""

    action_mean: Tensor
    action_std: Tensor

    def __init__(self, config: ModelConfig, context: ModelContext) -> None:
        super().__init__()
        self.config, self.context = config, context
        self.precision = torch.float32
        """What the network runs in; geometry, warping and blending always run in float32."""
        self._borrowing: Callable[[], AbstractContextManager[None]] = nullcontext
        self.camera = CameraModel.from_json(context.camera)
        height, width = self.camera.height, self.camera.width
        if height % STRIDE or width % STRIDE:
            raise UsageError(
                f"image size {height}x{width} is no multiple of {STRIDE}; collect pictures whose sides are"
            )
        self.action_dim = context.action_dim if config.act_cond else 0
        self.latent_channels = 0 if config.latents == "none" else 1
        self.encoder = Encoder(self.frame_channels, self.action_dim, self.latent_channels, config)
        self.embedding_size = self.encoder.channels[-1] * (height // STRIDE) * (width // STRIDE)
        self.register_buffer("action_mean", torch.tensor(context.action_mean), persistent=False)
        self.register_buffer("action_std", torch.tensor(context.action_std), persistent=False)

    @property
    def device(self) -> torch.device:
        """Where the model runs."""
        return self.action_mean.device

    @property
    def frame_gap(self) -> int:
        """Control steps from one frame to the next."""
        return self.context.frame_gap

    @property
    def latent_shape(self) -> tuple[int, int, int]:
        """(Z, H/8, W/8) of one latent; Z is 0 for a deterministic model."""
        return (self.latent_channels, self.camera.height // STRIDE, self.camera.width // STRIDE)

    @property
    def predicts_depth(self) -> bool:
        """Whether its predictions have depth and motion in space."""
        return self.frame_channels == 4

    def observe(self, rgb: Tensor, depth: Tensor, actions: Tensor | None = None) -> WorldState:
        """Take in context frames, `frame_gap` control steps apart.

        Args:
            rgb: (B, T, 3, H, W) in [0, 1].
            depth: (B, T, 1, H, W) metres; a model of pictures passes it on unseen.
            actions: (B, T-1, A), the aggregated action between each frame and the next; None is for a single frame and
                for action-free models.

        Returns:
            The state at the last frame.

        Raises:
            UsageError: the shapes are others, or colours are not in [0, 1].
        """
        batch, frames, _, height, width = rgb.shape if rgb.dim() == 5 else (0,) * 5
        if frames < 1 or rgb.shape[2] != 3 or depth.shape != (batch, frames, 1, height, width):
            raise UsageError(
                f"rgb is {tuple(rgb.shape)} and depth {tuple(depth.shape)}; give (B, T, 3, H, W) and (B, T, 1, H, W)"
            )
        if not (rgb.is_floating_point() and depth.is_floating_point()) or rgb.max() > BRIGHTEST:
            raise UsageError(
                f"rgb is {rgb.dtype} up to {float(rgb.max()):g} and depth {depth.dtype}; give floats, colours in [0, 1]"
                " and metres"
            )
        if actions is not None and actions.shape[:2] != (batch, frames - 1):
            raise UsageError(
                f"actions are {tuple(actions.shape)} for {frames} frames; give ({batch}, {frames - 1}, A), "
                "one for each gap between frames: aggregate_actions makes it of the actions of its control steps"
            )
        memory = self.blank_memory(rgb[:, 0])
        for t in range(rgb.shape[1] - 1):
            action = None if actions is None else actions[:, t]
            _, memory = self.predict(rgb[:, t], depth[:, t], action, None, memory, picture=False)
        return WorldState(rgb[:, -1].float(), depth[:, -1].float(), memory)

    def step(
        self,
        state: WorldState,
        action: Tensor | None,
        latent: Tensor | None = None,
        paint: bool = True,
        picture: bool = True,
    ) -> tuple[WorldState, Prediction]:
        """Go one frame onward.

        Args:
            state: of a batch of B, or of 1 from which all actions start.
            action: (B, A) in the dataset's units; None is for action-free models.
            latent: (B, Z, H/8, W/8), zeros when None.
            paint, picture: see `predict`.

        Returns:
            The state at the next frame, of a batch of B, and what was predicted of it.
        """
        prediction, memory = self.predict(
            state.rgb, state.depth, action, latent, state.memory, paint=paint, picture=picture
        )
        depth = expand(state.depth, len(prediction.rgb)) if prediction.depth is None else prediction.depth
        return WorldState(prediction.rgb, depth, memory), prediction

    def predict(
        self,
        rgb: Tensor,
        depth: Tensor,
        action: Tensor | None,
        latent: Tensor | None,
        memory: Memory,
        still: bool = False,
        paint: bool = True,
        picture: bool = True,
    ) -> tuple[Prediction, Memory]:
        """One frame, one action and a latent to the next frame.

        Args:
            rgb: (B, 3, H, W) in [0, 1].
            depth: (B, 1, H, W) metres.
            action: (B, A), aggregated over the frame gap; None is for action-free models, which ignore it.
            latent: (B, Z, H/8, W/8); zeros when None.
            memory: of the last step, or `blank_memory` at the start.
            still: let nothing move (identity transforms, kernels that copy), to see what is left without motion.
            paint: paint what was hidden before. Without it disoccluded pixels keep what was there; a third less work
                for T3VIP, for planners that look a few frames ahead.
            picture: make the next frame. Without it RGB and depth stay as they were and masks and motions are all that
                is predicted, which is what a planner needs of the last step that it looks ahead.

        Returns:
            The prediction and the new memory.

        Raises:
            UsageError: the model is conditioned on actions, and this is none of its actions.
        """
        if self.action_dim and (action is None or action.shape[1:] != (self.action_dim,)):
            given = "none was given" if action is None else f"that given has shape {tuple(action.shape)}"
            raise UsageError(f"{given}, but the model needs an action (B, {self.action_dim}); see its `context`")
        batch = max(rgb.shape[0], 0 if action is None else len(action), 0 if latent is None else len(latent))
        frame = self.frame(rgb, depth).contiguous(memory_format=torch.channels_last)
        if self.action_dim == 0 or action is None:
            action = rgb.new_zeros((batch, self.action_dim))
        else:
            action = expand(action, batch) if len(action) == 1 else action
            action = (action - self.action_mean) / self.action_std
        if self.latent_channels and latent is None:
            latent = rgb.new_zeros((batch, *self.latent_shape))
        device = rgb.device.type
        with torch.autocast(device, self.precision, enabled=self.precision != torch.float32), self._borrowing():
            heads, states = self.network(frame, action, latent, memory.states, paint)
        if len(rgb) < batch:
            rgb, depth, memory = expand(rgb, batch), expand(depth, batch), Memory([], memory.first)
            memory = memory.expand(batch)
        with torch.autocast(device, enabled=False):
            prediction = self.render(rgb.float(), depth.float(), heads, memory.first, still, picture)
        return prediction, Memory(states, memory.first)

    @contextmanager
    def lending(self) -> Iterator[None]:
        """Within the block, in which weights must not change, they are cast to the network's precision only once."""
        if self.precision == torch.float32:
            yield
            return
        loan = WeightLoan(self, self.precision)
        account = loan.open()
        self._borrowing = lambda: loan.frame(account)
        try:
            yield
        finally:
            self._borrowing = nullcontext

    def frame(self, rgb: Tensor, depth: Tensor) -> Tensor:
        """What the network sees of a frame: RGB, and for an RGB-D model depth scaled to [0, 1]; (..., C, H, W)."""
        if not self.predicts_depth:
            return rgb
        near, far = self.camera.near, self.camera.far
        return torch.cat((rgb, (depth - near) / (far - near)), dim=-3)

    def embed(
        self, frame: Tensor, action: Tensor, latent: Tensor | None, states: list[LSTMState]
    ) -> tuple[Tensor, Skips, list[LSTMState], list[LSTMState]]:
        """The trunk: to the motion embedding, the skips, the encoder's new states and the decoders' old ones.

        One past may have many futures: what was seen is then encoded once.
        """
        features, skips, seen = self.encoder.look(frame, states[:4])
        if len(action) > len(frame):
            count = len(action)
            features, skips = expand(features, count), [expand(skip, count) for skip in skips]
            seen, states = Memory(seen).expand(count).states, Memory(states).expand(count).states
        embedding, acted = self.encoder.act(features, action, latent, states[4])
        return embedding, skips, [*seen, acted], states[5:]

    @abstractmethod
    def network(
        self, frame: Tensor, action: Tensor, latent: Tensor | None, states: list[LSTMState], paint: bool
    ) -> tuple[Any, list[LSTMState]]:
        """All that is learned: scaled frame, normalised action and latent to what `render` needs, and new states."""

    @abstractmethod
    def render(
        self, rgb: Tensor, depth: Tensor, heads: Any, first: Tensor | None, still: bool, picture: bool = True
    ) -> Prediction:
        """The next frame, in float32, from the current one and the network's output."""

    def blank_memory(self, like: Tensor) -> Memory:
        """Zero states for a batch of first frames `like` (B, 3, H, W), in the precision that the network runs in."""
        small, middle, large = self.encoder.channels
        layout = [(small, 2), (small, 2), (middle, 4), (middle, 4), (large, 8)]
        layout += self.decoders * [(middle, 4), (small, 2)]
        states = []
        for channels, stride in layout:
            shape = (like.shape[0], channels, self.camera.height // stride, self.camera.width // stride)
            cell = torch.zeros(shape, device=like.device).contiguous(memory_format=torch.channels_last)
            states.append((cell.to(self.precision), cell))
        return Memory(states, like.float() if self.copies_first else None)
