"""Options of a training run, and the presets they start from."""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Literal

import tyro

from envs.errors import UsageError
from worldmodel.config import ModelConfig
from worldmodel.devices import Precision
from worldmodel.losses import LossWeights
from worldmodel.models import ModelName


@dataclass(frozen=True)
class Schedule:
    """When what happens, as fractions of the run, so that a short run is a small copy of a long one."""

    warmup: float = 0.02
    """The learning rate rises to here."""
    final_rate: float = 0.05
    """The learning rate ends, after a cosine, at this share of its peak."""
    truth_until: float = 0.6
    """Scheduled sampling: the share of true inputs falls from 1 at the start to 0 here (half at half of this)."""
    posterior_from: float = 0.25
    """Before this, latents are drawn from the prior; from here on from the inference network."""
    kl_ramp: tuple[float, float] = (0.25, 0.3)
    """The KL weight rises from 0 to its value between these. Where latents are free for long (from
    `posterior_from` on) they tell all that happens, and without them the model predicts that little does."""
    clip_lengths: tuple[tuple[float, int], ...] = ((0.3, 4), (0.6, 8), (1.0, 12))
    """Until which fraction of the run clips have how many frames: short clips first, where a step is cheap."""

    def __post_init__(self) -> None:
        for name in ("warmup", "final_rate"):
            if not 0 <= getattr(self, name) <= 1:
                raise UsageError(f"{name.replace('_', '-')} is {getattr(self, name)}; give a share from 0 to 1")
        for name in ("truth_until", "posterior_from"):  # beyond 1 is after the end
            if not getattr(self, name) >= 0:
                raise UsageError(
                    f"{name.replace('_', '-')} is {getattr(self, name)}; give a share of the run, 0 or more"
                )
        if not 0 <= self.kl_ramp[0] <= self.kl_ramp[1] <= 1:
            raise UsageError(f"kl-ramp is {self.kl_ramp}; give two fractions of the run, 0 to 1, the earlier one first")
        ends = [end for end, _ in self.clip_lengths]
        if not ends or ends != sorted(ends) or ends[-1] != 1.0 or min(frames for _, frames in self.clip_lengths) < 3:
            raise UsageError(
                f"clip-lengths is {self.clip_lengths}; give pairs (fraction, frames) with rising fractions that end at "
                "1.0 and at least 3 frames"
            )

    def clip_length(self, progress: float) -> int:
        """Frames of a clip at this fraction of the run."""
        return next(frames for end, frames in self.clip_lengths if progress <= end)


@dataclass(frozen=True)
class TrainOptions:
    """Train a world model on a dataset of `collect-rollouts`. The same command again goes on where it was.

    Options not given come from the preset: `tiny` (seconds; for trying things out), `cpu` (a model worth planning
    with in under two hours on two cores), `paper` (full width, 200,000 steps; for a GPU).
    """

    data: Path
    """Dataset to train on."""
    out: Path
    """Folder of the run: options, metrics, pictures, checkpoints, and the best model in `model/`."""
    preset: Literal["tiny", "cpu", "paper"] = "cpu"
    """Where the other options' values come from."""
    config: Path | None = None
    """JSON file of options that change the preset's, such as `best.json` of `tune-worldmodel` or `config.json` of
    another run. Options given here win over both."""
    validation: Path | None = None
    """Dataset to validate on; by default the last tenth of the training episodes is held out."""
    start_from: str | None = None
    """Start from the weights of this model, not from random ones: a shipped name (`t3vip`, `planar-push/t3vip`), or a
    run's folder. Model, architecture, frame gap and action column are then its own. It is validated before the first
    step, too, and stays the best until training makes it better."""
    model: ModelName = "t3vip"
    """t3vip-d is T3VIP without latents; sv2p, sna and cdna are its 2D rivals."""
    architecture: ModelConfig = field(default_factory=ModelConfig)
    """The network."""
    losses: LossWeights = field(default_factory=LossWeights)
    """The objective."""
    schedule: Schedule = field(default_factory=Schedule)
    """The curriculum."""
    frame_gap: int = 3
    """Control steps from one frame of a clip to the next; the actions between are added up."""
    action_column: Literal["auto", "action", "action_change", "action_followed", "joint_delta"] = "auto"
    """What the model is conditioned on: commanded actions; where these are absolute (DexHand), by how much each differs
    from the one before it, or how far joints go that follow them with a lag; or, where the data has it, how far each
    joint went, as in the paper. That tells of the outcome, and no planner knows it. `auto` is action_followed where all
    commands are absolute and the data tells of joints, else action; what it came to is written down."""
    context: int = 2
    """Frames that the model sees before it predicts."""
    steps: int = 200_000
    """Updates of the weights."""
    minutes: float | None = None
    """Instead of `steps`: as many as fill this time on this machine, validation and checkpoints included. Found by a
    trial before the first step and written down; a run that goes on keeps the number."""
    batch: int = 16
    """Clips a step."""
    learning_rate: float = 1e-3
    """Peak of Adam's learning rate."""
    clip_gradient: float = 1.0
    """Largest norm of the gradient."""
    colour_jitter: float = 0.3
    """How far each clip's colours are changed, lest the model cling to those of its scene; 0 for never."""
    seed: int = 0
    """Decides weights, clips and noise."""
    precision: Precision = "float32"
    """What the network runs in; geometry, splatting and losses always run in float32. `auto` is bfloat16 where the
    device has instructions for it, else float32; what it came to is written down, and a run that goes on keeps it."""
    device: str = "auto"
    """`cpu`, `cuda`, or `auto` for a GPU where there is one."""
    deterministic: bool = False
    """Have the same run give the same bits on the same machine, also on a GPU, at some cost in speed there."""
    cuda_graphs: bool = True
    """On a GPU, record what a step does there and replay it, instead of launching thousands of kernels one by one.
    Takes about the memory of a step more."""
    memory_limit: float | None = None
    """GB that the pictures of the datasets may take in memory; larger ones are read from the disk as they are needed.
    By default half of what is free, shared by the processes of torchrun."""
    validate_every: int = 2000
    """Steps from one validation, with pictures, to the next."""
    validation_clips: int = 64
    """Clips in the validation set."""
    save_every: int = 500
    """Steps from one checkpoint to the next."""
    log_every: int = 50
    """Steps from one line of metrics to the next."""

    def __post_init__(self) -> None:
        for name in ("steps", "batch", "validate_every", "validation_clips", "save_every", "log_every", "frame_gap"):
            if getattr(self, name) < 1:
                raise UsageError(f"{name.replace('_', '-')} is {getattr(self, name)}; give at least 1")
        if self.minutes is not None and not 0 < self.minutes < math.inf:
            raise UsageError(f"minutes is {self.minutes}; give a positive number such as 20, or --steps instead")
        if self.memory_limit is not None and not self.memory_limit >= 0:
            raise UsageError(f"memory-limit is {self.memory_limit}; give GB, or 0 to read everything from the disk")
        if not 0 < self.learning_rate < math.inf:
            raise UsageError(f"learning-rate is {self.learning_rate}; give a positive number such as 1e-3")
        if not self.clip_gradient > 0:
            raise UsageError(f"clip-gradient is {self.clip_gradient}; give a positive number, inf for no limit")
        for name in ("colour_jitter", "seed"):
            if not 0 <= getattr(self, name) < math.inf:
                raise UsageError(f"{name.replace('_', '-')} is {getattr(self, name)}; give a finite number, 0 or more")
        taught = ("rgb", "depth", "knn") if self.model.startswith("t3vip") else ("rgb",)
        if not any(getattr(self.losses, name) for name in taught):
            raise UsageError(
                f"loss weights of 0 for {', '.join(taught)} leave {self.model} nothing to learn from; give one of them "
                "more"
            )
        shortest = min(frames for _, frames in self.schedule.clip_lengths)
        if not 1 <= self.context < shortest:
            raise UsageError(
                f"context is {self.context}; give 1 to {shortest - 1}, fewer than the shortest clip's frames"
            )


_ANYWHERE = tyro.MISSING  # the command line must say

PRESETS: dict[str, TrainOptions] = {
    "paper": TrainOptions(_ANYWHERE, _ANYWHERE, "paper", precision="auto"),
    "cpu": TrainOptions(
        _ANYWHERE,
        _ANYWHERE,
        "cpu",
        architecture=ModelConfig(width=0.5, lstm_kernel=3),
        schedule=replace(Schedule(), clip_lengths=((0.45, 4), (0.8, 8), (1.0, 12))),
        steps=1600,
        validate_every=400,
        save_every=100,
        precision="auto",
    ),
    "tiny": TrainOptions(
        _ANYWHERE,
        _ANYWHERE,
        "tiny",
        architecture=ModelConfig(width=0.25, lstm_kernel=3, masks=4),
        schedule=replace(Schedule(), clip_lengths=((1.0, 4),)),
        steps=20,
        batch=4,
        validate_every=10,
        validation_clips=4,
        save_every=5,
        log_every=1,
    ),
}


def preset_for(name: str, model: str) -> TrainOptions:
    """A preset's options for a model. CDNA, SNA and SV2P learn from squared errors, as in their papers: with absolute
    ones they keep copying for long wherever little moves."""
    options = PRESETS[name]
    if model.startswith("t3vip"):
        return options
    return replace(options, losses=replace(options.losses, power=2))
