"""How far the fast training program strays from the plain one: bfloat16 and compiled, against float32 and eager.

    python -m tests.endurance.precision --data data/C --steps 50

Both begin with the same weights and go through the same clips and random draws, each by its own gradients. Prints both
losses of each step and in the end their greatest relative difference.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import torch

from data_collection.dataset import RGBDDataset
from tests.benchmarks.plain import plain_operators
from tests.benchmarks.subjects.training import make_trainer
from worldmodel.clips import ClipSource
from worldmodel.options import PRESETS
from worldmodel.trainer import Trainer

EPISODES = slice(0, 40)
FRAMES = 12


def main(arguments: Sequence[str] | None = None) -> None:
    """Train both, a step each in turn."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--data", type=Path, required=True)
    parser.add_argument("--steps", type=int, default=50)
    parser.add_argument("--batch", type=int, default=16)
    options = parser.parse_args(arguments)
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
    main()
