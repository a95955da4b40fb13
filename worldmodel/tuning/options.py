"""Options of `tune-worldmodel`, and the training that all of its trials share."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any, Literal

from envs.errors import UsageError
from worldmodel.config_file import read_config
from worldmodel.models import ModelName
from worldmodel.options import TrainOptions
from worldmodel.train import parse_options

SearcherName = Literal["random", "bohb", "hebo"]
PLACEMENT = ("out", "workers", "retries", "ray")
"""Options that say where trials run, not what comes out: they may change when a search goes on."""
TRAINING = ("data", "validation", "config")
"""Options that are in `training`, where a folder has one name, however it was given."""


@dataclass(frozen=True)
class TuneOptions:
    """Search for the learning rate and loss weights with which a world model learns best on a dataset.

    The first trial has the preset's own values. A weight that is 0 there, or in the config file, stays 0. The same
    command again goes on where it was.
    """

    data: Path
    """Dataset to train on."""
    out: Path
    """Folder of the search: `best.json` for train-worldmodel --config, `report.json`, `report.md`, pictures, and the
    trials."""
    preset: Literal["tiny", "cpu", "paper"] | None = None
    """Preset of train-worldmodel that all trials start from; by default the config file's, or cpu."""
    trials: int = 30
    """Configurations to try. A search goes on with the same number or, where the searcher is random, with more."""
    validation: Path | None = None
    """Dataset to validate on; by default the last tenth of the training episodes is held out."""
    model: ModelName | None = None
    """As for train-worldmodel."""
    config: Path | None = None
    """JSON file of further options of train-worldmodel that all trials share, such as frame_gap."""
    steps: int | None = None
    """The full budget of a trial; by default the preset's."""
    reduction: int = 3
    """At each rung about one of so many trials goes on (eta of successive halving)."""
    rungs: int = 2
    """How often a trial may be stopped: after 1/reduction of the full budget, 1/reduction^2, ...; 0 for never."""
    unpruned: int = 1
    """So many trials run to the end whatever their scores: the first has the preset's values, and some more tell how
    well small budgets foretell the full one (12 for a figure)."""
    around: float | None = None
    """Search within this factor of the preset's values (3: from a third to three times), not in the paper's ranges."""
    searcher: Literal["random", "bohb", "hebo"] = "random"
    """Where configurations come from; bohb and hebo need packages of their own."""
    seed: int = 0
    """Decides which configurations are tried; the weights and clips of all trials come from the preset's seed."""
    workers: int | None = None
    """Trials side by side; by default as many as there are CPUs (of the cluster) for them."""
    cpus_per_trial: int = 1
    """CPUs, and threads, of a trial."""
    gpus_per_trial: float = 0.0
    """GPUs of a trial; with 0.5 two share one, with 0 it runs on CPUs."""
    retries: int = 3
    """How often a trial whose process dies is started again from its own last checkpoint."""
    ray: str | None = None
    """HOST:PORT of a running Ray cluster, auto for the one of this machine, or local, as by default, for one that is
    started here and ends with the command."""

    def __post_init__(self) -> None:
        for name, least in (("trials", 1), ("unpruned", 1), ("reduction", 2), ("rungs", 0), ("cpus_per_trial", 1),
                            ("gpus_per_trial", 0), ("retries", 0), ("seed", 0)):  # fmt: skip
            if not getattr(self, name) >= least:
                raise UsageError(f"{name.replace('_', '-')} is {getattr(self, name)}; give at least {least}")
        if self.unpruned > self.trials:
            raise UsageError(f"unpruned is {self.unpruned} of {self.trials} trials; give fewer, or more --trials")
        if self.around is not None and not 1 < self.around < math.inf:
            raise UsageError(f"around is {self.around:g}; give a factor above 1, such as 3")
        if self.workers is not None and self.workers < 1:
            raise UsageError(f"workers is {self.workers}; give at least 1")

    @cached_property
    def training(self) -> TrainOptions:
        """What all trials share; their own values take the place of some.

        Raises:
            UsageError: the config file does not do.
        """
        told = {
            "data": self.data.resolve(),  # processes on a cluster work in other folders
            "out": self.out.resolve() / "trials",
            "preset": self.preset,
            "validation": self.validation and self.validation.resolve(),
            "model": self.model,
            "config": self.config,
            "steps": self.steps,
        }
        words = [word for name, value in told.items() if value is not None for word in (f"--{name}", str(value))]
        options = parse_options(words)
        if options.minutes is not None:
            raise UsageError(f"--config {self.config} has minutes; give --steps, which all trials share")
        if options.start_from is not None:
            raise UsageError(f"--config {self.config} has start_from; take it out: trials start from new weights")
        return replace(
            options,
            device="cuda" if self.gpus_per_trial else "cpu",
            validate_every=self.budgets_of(options.steps)[0],
        )

    @property
    def budgets(self) -> tuple[int, ...]:
        """Steps after which a trial may be stopped, and those of the whole run."""
        return self.budgets_of(self.training.steps)

    def budgets_of(self, steps: int) -> tuple[int, ...]:
        """The budgets of a full run of so many steps.

        Raises:
            UsageError: there are too few.
        """
        smallest = self.reduction**self.rungs
        if steps < smallest:
            raise UsageError(
                f"steps is {steps}, too few for {self.rungs} rungs, each {self.reduction} times the one before; give "
                f"at least {smallest}, or fewer --rungs"
            )
        first = -(-steps // smallest)
        rungs = tuple(first * self.reduction**k for k in range(self.rungs))
        return (*rungs, steps)

    @property
    def shared(self) -> dict[str, Any]:
        """What `train-worldmodel --config` must be told for a run of these trials' kind, beside their own values."""
        values = {} if self.config is None else read_config(self.config)
        values = {name: value for name, value in values.items() if name not in ("data", "validation", "steps")}
        return values | {"preset": self.training.preset, "model": self.training.model}

    def document(self) -> dict[str, Any]:
        """What must be the same when a search goes on, beside `training`."""
        return {name: getattr(self, name) for name in self.__dataclass_fields__ if name not in (*PLACEMENT, *TRAINING)}
