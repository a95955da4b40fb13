"""One contestant's training: a `train-worldmodel` run in a process of its own."""

from __future__ import annotations

import ctypes
import json
import os
import shlex
import signal
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from envs.errors import UsageError
from worldmodel.checkpoint import STATE, WEIGHTS
from worldmodel.study.options import StudyOptions
from worldmodel.study.plan import Contestant
from worldmodel.train import command, existing_run, parse_options
from worldmodel.training_data import settled

_PR_SET_PDEATHSIG = 1  # <linux/prctl.h>


@dataclass(frozen=True)
class Progress:
    """How far a run is."""

    step: int
    steps: int
    seconds: float
    """Of training so far."""
    whole: bool
    """Whether it came to its end and left a model."""


def folder_of(options: StudyOptions, contestant: Contestant) -> Path:
    """Where a contestant is trained."""
    return options.out / "models" / contestant.run


def arguments_of(options: StudyOptions, contestant: Contestant) -> list[str]:
    """What `train-worldmodel` is told for a contestant; only its last arguments differ between contestants."""
    told: dict[str, Any] = {
        "preset": options.preset,
        "data": options.train,
        "validation": options.validation,
        "out": folder_of(options, contestant),
        "seed": options.seed,
        "device": options.device,
        "frame-gap": contestant.gap,
    }
    told |= {} if options.config is None else {"config": options.config}
    told |= {"minutes": options.minutes} if options.steps is None else {"steps": options.steps}
    return [word for name, value in told.items() for word in (f"--{name}", str(value))] + list(contestant.arguments)


def command_of(options: StudyOptions, contestant: Contestant) -> str:
    """The same as a command line."""
    return shlex.join(["train-worldmodel", *arguments_of(options, contestant)])


def progress_of(options: StudyOptions, contestant: Contestant) -> Progress | None:
    """How far a contestant's training is; None before its first checkpoint.

    Raises:
        UsageError: the folder holds a run with other options.
    """
    run = existing_run(settled(parse_options(arguments_of(options, contestant))))
    states = sorted(folder_of(options, contestant).glob(f"checkpoints/step-????????/{STATE}"))
    if run is None or not states:
        return None
    state = json.loads(states[-1].read_text())
    whole = state["step"] >= run.steps and (run.out / "model" / WEIGHTS).is_file()
    return Progress(state["step"], run.steps, state["seconds"], whole)


def train(options: StudyOptions, contestant: Contestant, inherited: int) -> Progress:
    """Train a contestant to its end, from where it stands.

    When this process is asked to stop, it passes that on, and the trainer saves first. When it is killed, so is the
    trainer (on Linux; elsewhere the trainer goes on to its end, and holds the lock until then).

    Args:
        inherited: file descriptor that the trainer keeps open too: the study's lock.

    Raises:
        UsageError: the trainer ended before it was done.
    """
    told = arguments_of(options, contestant)
    line = [sys.executable, "-m", "worldmodel.study.training", str(os.getpid()), *told]
    with _stoppable():
        # In a session of its own, Ctrl-C reaches it as SIGTERM only, and it saves.
        trainer = subprocess.Popen(line, pass_fds=(inherited,), start_new_session=True)
        try:
            code = trainer.wait()
        except BaseException:
            trainer.terminate()
            trainer.wait()
            raise
    done = progress_of(options, contestant)
    if code == 0 and done is not None and done.whole:
        return done
    where = "before its first checkpoint" if done is None else f"at step {done.step} of {done.steps}"
    raise UsageError(
        f"the training of {contestant.run} stopped {where} (exit code {code}); the same command goes on from there"
    )


@contextmanager
def _stoppable() -> Iterator[None]:
    """SIGTERM ends this process like Ctrl-C does, by an exception, with the usual exit code."""

    def stop(number: int, frame: Any) -> None:
        raise SystemExit(128 + number)

    try:
        before = signal.signal(signal.SIGTERM, stop)
    except ValueError:  # not in the main thread: nobody can signal us
        yield
        return
    try:
        yield
    finally:
        signal.signal(signal.SIGTERM, before)


def _die_with(parent: int) -> None:
    """Have the kernel send SIGTERM to this process when its parent dies, however it dies."""
    if sys.platform.startswith("linux"):
        ctypes.CDLL(None).prctl(_PR_SET_PDEATHSIG, signal.SIGTERM)
    if os.getppid() != parent:  # it died before we asked
        sys.exit(128 + signal.SIGTERM)


if __name__ == "__main__":
    _die_with(int(sys.argv.pop(1)))
    command()
