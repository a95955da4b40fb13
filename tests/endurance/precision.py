"""How far the fast training program strays from the plain one: bfloat16 and compiled, against float32 and eager.

    python -m tests.endurance.precision --data data/C --steps 50

Both begin with the same weights and go through the same clips and random draws, each by its own gradients. Prints both
losses of each step and in the end the median and the greatest of their relative differences; the exit code is 1 if that
is above `--limit`. Where the processor has no instructions for bfloat16 it is emulated, slowly.
"""

from __future__ import annotations

import statistics
from dataclasses import dataclass, replace
from pathlib import Path

import torch

from data_collection.dataset import RGBDDataset
from envs import command as command_line
from envs.errors import UsageError
from tests.benchmarks.plain import plain_operators
from tests.benchmarks.subjects.training import make_trainer
from worldmodel.checkpoint import load_training
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
    width: float = 0.5
    """Of the network."""
    begin: float = 0.0
    """Where in its schedule the run begins, as a share of it: from 0.6 on models see no more true frames, latents are
    inferred, and the KL counts in full."""
    run: Path | None = None
    """A run of `train-worldmodel` whose last checkpoint's weights both begin with; else they begin at random."""
    limit: float = 0.01
    """Greatest relative difference that passes."""


def main(options: PrecisionOptions) -> None:
    """Train both, a step each in turn."""
    source = ClipSource(RGBDDataset(options.data), PRESETS["cpu"].frame_gap, EPISODES)
    fast, plain = (_trainer(kind, source, options) for kind in ("ours", "plain"))
    differences = []
    for step in range(fast.step, fast.step + options.steps):
        fast.step = plain.step = step
        clips = plain.next_clips()
        ours = fast.update(clips)["loss"]
        with torch.compiler.set_stance("force_eager"), plain_operators():
            theirs = plain.update(clips)["loss"]
        differences.append(abs(ours / theirs - 1))
        print(f"step {step}: {ours:.6f}, plain {theirs:.6f}", flush=True)
    greatest = max(differences)
    print(f"relative difference: median {statistics.median(differences):.1e}, greatest {greatest:.1e}")
    raise SystemExit(int(greatest > options.limit))


def _trainer(kind: str, source: ClipSource, options: PrecisionOptions) -> Trainer:
    """The `cpu` preset's, on clips of full length from the beginning."""
    preset = PRESETS["cpu"]
    schedule = replace(preset.schedule, clip_lengths=((1.0, FRAMES),))
    architecture = replace(preset.architecture, width=options.width)
    precision = "bfloat16" if kind == "ours" else "float32"
    trainer = make_trainer(
        kind, "cpu", schedule=schedule, architecture=architecture, batch=options.batch, precision=precision
    )
    if options.run is not None and load_training(options.run, trainer.modules, trainer.optimiser) is None:
        raise UsageError(f"{options.run} has no checkpoint; give a run of train-worldmodel")
    trainer.train_clips, trainer.step = source, round(options.begin * trainer.options.steps)
    trainer.model.train()
    return trainer


if __name__ == "__main__":
    command_line.run(PrecisionOptions, main)
