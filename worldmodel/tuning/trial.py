"""One trial: a run of the ordinary trainer in a folder of its own, which tells its scores."""

from __future__ import annotations

import json
import math
import os
import shutil
import socket
from dataclasses import replace
from statistics import fmean
from typing import Any

import torch
from ray import tune

from envs.errors import UsageError
from worldmodel.clips import ClipSource
from worldmodel.devices import find_device, prepare_devices
from worldmodel.held_out import ValidationSet
from worldmodel.memory import keep_freed_memory
from worldmodel.options import TrainOptions
from worldmodel.ranks import Ranks
from worldmodel.train import claim, existing_run, make_trainer
from worldmodel.trainer import Diverged
from worldmodel.tuning.journal import PARTS
from worldmodel.tuning.space import at_point
from worldmodel.validation import Scores

WORST_DB = 0.0
"""The score of a trial that diverged: below that of any picture."""


def run_trial(
    config: dict[str, Any], training: TrainOptions, data: tuple[ClipSource, ValidationSet], threads: int
) -> None:
    """Train with one configuration; goes on at the trial's last checkpoint, if it has one.

    Each score is told after a checkpoint is on the disk. A trial that goes on tells its earlier scores again first, so
    that none is lost wherever the search was when it ended.

    Args:
        config: a point of the search space, and the trial's `number`.
        training: what all trials share; `out` is the folder of their folders.
        data: clips to train and to validate on, in memory that all trials share and nobody writes to.
        threads: to compute with.
    """
    keep_freed_memory()
    prepare_devices(training.deterministic)
    torch.set_num_threads(threads)
    point = {name: value for name, value in config.items() if name != "number"}
    options = replace(at_point(training, point), out=training.out / f"{config['number']:03d}")
    try:
        options = existing_run(options) or claim(options)
    except UsageError:  # the folder holds another configuration: the search has lost its state and drew anew
        shutil.rmtree(options.out)
        options = claim(options)
    trainer = make_trainer(options, *data, Ranks(device=find_device(options.device)))

    def tell(scores: Scores) -> None:
        if not math.isfinite(_mean(scores["score"])):
            raise Diverged("the score is not finite")
        trainer.save()
        _report(trainer.step, scores, seconds=trainer.seconds)

    for line in _validations(options):
        _report(line["step"], line)  # how long it took is not written there
    try:
        trainer.run(tell)
    except Diverged as error:
        tune.report({"step": trainer.step, "score": WORST_DB, "diverged": True, "reason": str(error)})


def _report(step: int, scores: Scores, **measured: float) -> None:
    told: dict[str, Any] = {name: _mean(scores[name]) for name in ("score", *PARTS) if name in scores}
    told |= {"step": step, "diverged": False, "host": socket.gethostname(), "pid": os.getpid()}
    tune.report(told | measured)


def _validations(options: TrainOptions) -> list[dict[str, Any]]:
    """The validations that an earlier process of this trial wrote down, in order."""
    path = options.out / "metrics.jsonl"
    lines: dict[int, dict[str, Any]] = {}
    for text in path.read_text().splitlines() if path.exists() else ():
        try:
            line = json.loads(text)
        except ValueError:  # torn by a kill
            continue
        if line.get("kind") == "validation" and line["score"] is not None:  # None: it was no number
            lines[line["step"]] = line
    return [lines[step] for step in sorted(lines)]


def _mean(value: float | list[float]) -> float:
    return fmean(value) if isinstance(value, list) else value
