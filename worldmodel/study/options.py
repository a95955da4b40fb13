"""Options of `run-study`."""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import tyro

from envs.errors import UsageError
from worldmodel.sampling import Selection
from worldmodel.study.plan import STUDIES, Contestant, Study, StudyName


@dataclass(frozen=True)
class StudyOptions:
    """Train and score the models of one of the paper's tables, with an equal budget each, one after the other.

    The same command again goes on where it was: what is trained and scored is not done again. After each model the
    report is written anew.
    """

    study: tyro.conf.Positional[StudyName]
    """`table`: T3VIP against CDNA, SNA and SV2P; `ablation`: M1 to M6; `action-free`: models that see no actions."""
    train: Path
    """Dataset that all models are trained on."""
    validation: Path
    """Dataset on which each run chooses its best model."""
    test: Path
    """Dataset that all models are scored on, and none is trained on."""
    out: Path
    """Folder of the study: models/, scores/, study.json, study.md, curves.png, bars.png."""
    minutes: float = 20.0
    """Training time of each model on this machine."""
    steps: int | None = None
    """Instead of `minutes`: so many training steps each."""
    only: tuple[str, ...] = ()
    """Names of the models to train and score now, such as `t3vip` or `t3vip-gap3`; all when not given."""
    gap: tuple[int, ...] = ()
    """Frame gaps to train and test at; the study's own when not given."""
    horizons: tuple[int, ...] = ()
    """Predicted frames over which scores are averaged; the study's own when not given. The longest is predicted."""
    samples: int = 100
    """Futures of each test clip of which the best counts, for models with latents; 0 for latents at 0 only, which is
    far faster."""
    select: Selection = "vgg"
    """What the best sample is the best in; see `evaluate-worldmodel`."""
    clips: int = 40
    """Test clips."""
    vgg: bool = True
    """Score by VGG too; fetches its weights (60 MB) the first time."""
    preset: Literal["tiny", "cpu", "paper"] = "cpu"
    """Of `train-worldmodel`."""
    config: Path | None = None
    """Of `train-worldmodel`: a JSON file of options that change the preset's, the same for all models."""
    seed: int = 0
    """Of training and of the samples."""
    device: str = "auto"
    """`cpu`, `cuda`, or `auto` for a GPU where there is one."""

    def __post_init__(self) -> None:
        if not 0 < self.minutes < math.inf:
            raise UsageError(f"minutes is {self.minutes}; give a positive number such as 20")
        for name in ("steps", "clips"):
            value = getattr(self, name)
            if value is not None and value < 1:
                raise UsageError(f"{name} is {value}; give at least 1")
        if self.samples < 0:
            raise UsageError(f"samples is {self.samples}; give 0 for latents at 0 only, or for example 100")
        for name in ("gap", "horizons"):
            if any(value < 1 for value in getattr(self, name)):
                raise UsageError(f"{name} is {getattr(self, name)}; give numbers of at least 1")
        names = {name for contestant in self.contestants for name in (contestant.name, contestant.run)}
        for name in self.only:
            if name not in names:
                raise UsageError(f"no model '{name}' in this study; there are {', '.join(sorted(names))}")

    @property
    def plan(self) -> Study:
        """What is compared."""
        return STUDIES[self.study]

    @property
    def contestants(self) -> list[Contestant]:
        """All models of the study."""
        return self.plan.contestants(self.gap)

    @property
    def chosen(self) -> list[Contestant]:
        """Those to train and score now."""
        return [c for c in self.contestants if not self.only or {c.name, c.run} & set(self.only)]

    @property
    def averaged(self) -> tuple[int, ...]:
        """The horizons, rising."""
        return tuple(sorted(set(self.horizons or self.plan.horizons)))
