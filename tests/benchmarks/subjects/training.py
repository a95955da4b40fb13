"""Seconds of a training step of the `cpu` preset on clips that are made up."""

from __future__ import annotations

import contextlib
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import torch

from data_collection.schema import dequantise_depth
from envs.camera import CameraModel
from tests.benchmarks.plain import PLAIN, plain_operators
from tests.benchmarks.timing import median_seconds
from worldmodel.clips import ClipSource
from worldmodel.config import ModelContext
from worldmodel.memory import keep_freed_memory
from worldmodel.models import make_model, named_config
from worldmodel.options import PRESETS, TrainOptions
from worldmodel.trainer import Trainer

SIZE, NEAR, FAR = 64, 3.4, 6.3  # the tabletop's, pixels and metres
ACTION_DIM = 7
LATE = 0.9  # of the run: clips at full length, no true frames, latents from the inference network, all losses


def step_seconds(kind: str, preset: str, repeats: int) -> dict[str, float]:
    """Median seconds of an update of T3VIP ("update"), and of waiting for its clips ("wait")."""
    trainer = make_trainer(kind, preset)
    clips = trainer.next_clips()
    trainer.model.train()
    with as_plainly(kind), plain_operators() if kind == "plain" else contextlib.nullcontext():
        update = median_seconds(lambda: trainer.update(clips), repeats)
    return {"update": update, "wait": median_seconds(trainer.next_clips, repeats)}


def cdna_step_seconds(kind: str, preset: str, width: float, frames: int, repeats: int) -> float:
    """Median seconds of an update of CDNA, kernels of 5 x 5 as in the original."""
    options = PRESETS[preset]
    architecture = replace(options.architecture, width=width, kernel_size=5)
    schedule = replace(options.schedule, clip_lengths=((1.0, frames),))
    trainer = make_trainer(kind, preset, model="cdna", architecture=architecture, schedule=schedule)
    clips = trainer.next_clips()
    trainer.model.train()
    with as_plainly(kind):
        return median_seconds(lambda: trainer.update(clips), repeats)


def as_plainly(kind: str) -> contextlib.AbstractContextManager[object]:
    """Within the block nothing is compiled that is "plain"."""
    return torch.compiler.set_stance("force_eager") if kind == "plain" else contextlib.nullcontext()


def make_trainer(kind: str, preset: str, device: str = "cpu", **changes: Any) -> Trainer:
    """A trainer late in its run: "ours" as `train-worldmodel` makes it, or "plain": fp32, default layout."""
    options: TrainOptions = replace(PRESETS[preset], data=Path("unused"), out=Path("unused"), **changes)
    torch.manual_seed(options.seed)
    name, architecture = named_config(options.model, options.architecture)
    options, context = replace(options, architecture=architecture), _context(options.frame_gap)
    if kind == "plain":
        options = replace(options, precision="float32")
        model = PLAIN[name](architecture, context)
    else:
        keep_freed_memory()
        model = make_model(name, architecture, context).to(memory_format=torch.channels_last)  # type: ignore[call-overload]
    model = model.to(device)
    source = ClipSource(MadeUpDataset(), options.frame_gap)  # type: ignore[arg-type]
    trainer = Trainer(model, options, source, None, {})  # type: ignore[arg-type]  # nothing is validated
    trainer.step = round(LATE * options.steps)
    return trainer


class MadeUpDataset:
    """Episodes of noise in memory, of the sizes and types of a real dataset's."""

    attrs: dict[str, Any] = {  # noqa: RUF012
        "action_aggregation": ("sum",) * 3 + ("rotate",) * 3 + ("last",),
        "action_scale": (0.02,) * 3 + (0.05,) * 3 + (1.0,),
    }

    def __init__(self, episodes: int = 8, rows: int = 241) -> None:
        rng = np.random.default_rng(0)
        shape = (episodes * rows, SIZE, SIZE)
        self._columns: dict[str, np.ndarray] = {
            "rgb": rng.integers(0, 256, (*shape, 3), np.uint8),
            "depth": rng.integers(20_000, 40_000, shape, np.uint16),
            "action": rng.uniform(-1, 1, (shape[0], ACTION_DIM)).astype(np.float32),
        }
        starts = rows * np.arange(episodes)
        self.episode_slices = np.stack([starts, starts + rows], axis=1)

    def load(self, column: str) -> np.ndarray:
        return self._columns[column]

    def depth_metres(self, raw: np.ndarray) -> np.ndarray:
        return dequantise_depth(raw, NEAR, FAR)


def _context(frame_gap: int) -> ModelContext:
    camera = CameraModel.from_fovy(SIZE, SIZE, 10.0, np.eye(4), NEAR, FAR)
    return ModelContext(
        env_id="t3vip/TabletopC-v0",
        camera=camera.to_json(),
        action_dim=ACTION_DIM,
        frame_gap=frame_gap,
        control_rate=30.0,
        action_aggregation=MadeUpDataset.attrs["action_aggregation"],
        action_scale=MadeUpDataset.attrs["action_scale"],
        action_mean=(0.0,) * ACTION_DIM,
        action_std=(1.0,) * ACTION_DIM,
    )
