"""How far the fast training program strays from the plain one: bfloat16 and compiled, against float32 and eager.

    python -m tests.endurance.precision --data data/C --steps 50

Both begin with the same weights and go through the same clips and random draws, each by its own gradients. Prints both
losses of each step and in the end their greatest relative difference.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

import torch

from data_collection.dataset import RGBDDataset
from envs import command as command_line
from tests.benchmarks.plain import plain_operators
from tests.benchmarks.subjects.training import make_trainer
from worldmodel.clips import ClipSource
from worldmodel.options import PRESETS
from worldmodel.trainer import Trainer

EPISODES = slice(0, 40)
FRAMES = 12


@dataclass(frozen=True)
class PrecisionOptions:
    """How far does the fast training program stray from the plain one?"""

    data: Path
    """Dataset whose clips both train on."""
    steps: int = 50
    """Updates of the weights."""
    batch: int = 16
    """Clips a step."""


def main(options: PrecisionOptions) -> None:
    """Train both, a step each in turn."""
    source = ClipSource(RGBDDataset(options.data), PRESETS["cpu"].frame_gap, EPISODES)
    fast, plain = (_trainer(kind, source, options.batch) for kind in ("ours", "plain"))
    greatest = 0.0
    for step in range(options.steps):
        clips = plain.next_clips()
        ours = fast.update(clips)["loss"]
        with torch.compiler.set_stance("force_eager"), plain_operators():
            theirs = plain.update(clips)["loss"]
        greatest = max(greatest, abs(ours / theirs - 1))
        print(f"step {step}: {ours:.6f}, plain {theirs:.6f}", flush=True)
        fast.step = plain.step = step + 1
    print(f"greatest relative difference: {greatest:.1e}")


def _trainer(kind: str, source: ClipSource, batch: int) -> Trainer:
    """The `cpu` preset's at its first step, on clips of full length from the beginning."""
    schedule = replace(PRESETS["cpu"].schedule, clip_lengths=((1.0, FRAMES),))
    trainer = make_trainer(kind, "cpu", schedule=schedule, batch=batch)
    trainer.train_clips, trainer.step = source, 0
    trainer.model.train()
    return trainer


if __name__ == "__main__":
    command_line.run(PrecisionOptions, main)
