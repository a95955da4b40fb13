"""How many steps fill a given time on this machine."""

from __future__ import annotations

import tempfile
import time
from collections.abc import Callable, Iterator
from contextlib import closing
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from envs.errors import UsageError
from worldmodel.journal import Journal
from worldmodel.options import Schedule, TrainOptions
from worldmodel.trainer import Trainer

STEPS_TIMED = 5
TRIAL_STEPS = 1000
"""Length of the run that the trial pretends to be in: how finely a place in the schedule can be told."""


@dataclass(frozen=True)
class Cost:
    """What a run takes, seconds."""

    step: float
    """A step, waiting for its clips included: the mean over the whole curriculum."""
    validation: float
    checkpoint: float

    def steps_in(self, seconds: float, options: TrainOptions) -> int:
        """The most steps of a run that ends within `seconds`, validations and checkpoints included.

        Raises:
            UsageError: not even one step fits.
        """
        rate = self.step + self.validation / options.validate_every + self.checkpoint / options.save_every
        validations = 1 if options.start_from is None else 2  # once more at the end, and what a run starts from
        steps = int((seconds - validations * self.validation - self.checkpoint) / rate)
        if steps < 1:
            raise UsageError(
                f"minutes is {seconds / 60:g}, and one step, validation and checkpoint take "
                f"{(self.step + self.validation + self.checkpoint) / 60:.2g}; give more, or fewer --validation-clips"
            )
        return steps


def measure_cost(make_trainer: Callable[[TrainOptions], Trainer], options: TrainOptions) -> Cost:
    """Try out every part of the curriculum on a trainer that is then thrown away.

    Each part's first step, which may wait for the compiler, does not count; of the others the fastest does, for what
    else the machine is doing now says nothing about the hours to come.

    Args:
        make_trainer: makes a trainer of its own, in a fresh state; what it writes goes into a temporary folder.
        options: of the run.
    """
    with tempfile.TemporaryDirectory() as folder:
        trial = make_trainer(replace(options, out=Path(folder), steps=TRIAL_STEPS))
        step = sum((end - start) * _step_seconds(trial, 0.5 * (start + end)) for start, end in _parts(options.schedule))
        with closing(Journal(Path(folder), 0)) as journal:
            whole = trial.validation
            trial.validation = replace(whole, clips=min(whole.clips, whole.batch))
            trial.score(journal)
            trial.validation = whole
            validation = _seconds(lambda: trial.score(journal))
        trial.save()
        return Cost(step, validation, _seconds(trial.save))


def _parts(schedule: Schedule) -> Iterator[tuple[float, float]]:
    """Stretches of the run, as fractions of it, in which all steps cost the same."""
    ends = {schedule.posterior_from, *(end for end, _ in schedule.clip_lengths)}
    start = 0.0
    for end in sorted(end for end in ends if 0 < end <= 1):
        yield start, end
        start = end


def _step_seconds(trial: Trainer, progress: float) -> float:
    trial.step = round(progress * TRIAL_STEPS)

    def step() -> None:
        trial.model.train()
        trial.update(trial.next_clips())
        trial.step += 1

    step()
    return min(_seconds(step) for _ in range(STEPS_TIMED))


def _seconds(work: Callable[[], Any]) -> float:
    start = time.perf_counter()
    work()
    return time.perf_counter() - start
