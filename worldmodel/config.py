"""What a world model is: the numbers that are stored beside its weights."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal

from envs.errors import UsageError
from worldmodel.splatting import SplatMode

LatentKind = Literal["none", "step", "clip"]
Evidence = Literal["changes", "frames"]


@dataclass(frozen=True)
class ModelConfig:
    """Architecture of a model.

    By default widths, ConvLSTM kernels and the number of masks are the paper's; docs/model.md lists what departs.
    """

    width: float = 1.0
    """Multiplier on every channel count: 1.0 is the paper's network, 0.5 the CPU preset's."""
    lstm_kernel: int = 5
    """Kernel of the ConvLSTMs."""
    fine_skip: bool = True
    """Whether decoders see the frame at full resolution; the paper's do not."""
    masks: int = 10
    """K: T3VIP's masks, the first of them the background, which never moves; the rivals' kernels."""
    kernel_size: int = 15
    """Of CDNA, SNA and SV2P: width of the kernels in pixels, 5 in the originals. They move a pixel by half of that at
    most; where things go farther from frame to frame, these models cannot follow."""
    latents: LatentKind = "step"
    """One latent a step, one a clip, or none; CDNA, SNA and T3VIP-D have none in any case."""
    inferred_from: Evidence = "changes"
    """What the inference network sees: how each frame differs from the clip's mean, or the frames themselves, as in the
    paper. Of frames nearly all stands still; latents inferred from them came to carry nothing."""
    act_cond: bool = True
    """Whether the model sees actions."""
    splat: SplatMode = "over"
    """How points that land on the same pixel share it: `over` lays the nearer over the farther."""
    splat_sharpness: float = 3.0
    """Of splat `softmax`, in 1/metre."""
    translation_unit: float = 10.0
    """T3VIP's translations are learned in units of so many pixels (at mid depth). In large units they learn faster than
    masks: the background then keeps most of every pixel and what is left of it goes far, the hand as one piece."""
    first_shift: float = 0.0
    """T3VIP's transforms start out with shifts of about so many pixels, each its own, that depend on the action; 0
    starts with the identity, as the paper. Where a hundredth of the picture moves, 1 finds the motion far sooner."""
    mask_head_std: float = 0.5
    """Initial spread of the mask head's weights. Masks that start out alike never come apart."""

    def __post_init__(self) -> None:
        if not 0 < self.width < math.inf:
            raise UsageError(f"width is {self.width}; give a positive multiplier such as 0.5 or 1.0")
        if self.lstm_kernel < 1 or self.lstm_kernel % 2 == 0:
            raise UsageError(f"lstm-kernel is {self.lstm_kernel}; give an odd number such as 3 or 5")
        if self.kernel_size < 1 or self.kernel_size % 2 == 0:
            raise UsageError(f"kernel-size is {self.kernel_size}; give an odd number such as 5 or 15")
        if self.masks < 2:
            raise UsageError(f"masks is {self.masks}; give at least 2 (a background and one that moves)")
        if not 0 < self.translation_unit < math.inf:
            raise UsageError(f"translation-unit is {self.translation_unit}; give a positive number of pixels")
        for name in ("first_shift", "splat_sharpness", "mask_head_std"):
            if not 0 <= getattr(self, name) < math.inf:
                raise UsageError(f"{name.replace('_', '-')} is {getattr(self, name)}; give a finite number, 0 or more")


@dataclass(frozen=True)
class ModelContext:
    """What a model was made for: it comes from the dataset and travels with the checkpoint."""

    env_id: str
    """Gymnasium id of the environment that the data came from."""
    camera: str
    """CameraModel as JSON."""
    action_dim: int
    frame_gap: int
    """Control steps from one frame of the model to the next."""
    control_rate: float
    """Control steps a second."""
    action_aggregation: tuple[str, ...]
    """How each action dimension adds up over the frame gap."""
    action_scale: tuple[float, ...]
    """Metres or radians that one unit of each action dimension stands for."""
    action_mean: tuple[float, ...]
    action_std: tuple[float, ...]
    """Statistics of aggregated training actions, for normalisation inside the model."""
    action_column: str = "action"
    """The column of a dataset that the model takes as its actions."""
