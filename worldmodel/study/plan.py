"""Which models a study trains: each contestant is one `train-worldmodel` command, and they differ in what it says."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

StudyName = Literal["table", "ablation", "action-free"]


@dataclass(frozen=True)
class Contestant:
    """A model of a study at one frame gap."""

    name: str
    """Within its study."""
    title: str
    gap: int
    arguments: tuple[str, ...]
    """Of `train-worldmodel`: what sets it apart."""

    @property
    def run(self) -> str:
        """Name of its folder and of its entry in study.json."""
        return f"{self.name}-gap{self.gap}"


@dataclass(frozen=True)
class Study:
    """What is compared with what."""

    title: str
    question: str
    models: tuple[tuple[str, str, tuple[str, ...]], ...]
    """Name, title and arguments of each model, in the order of the paper's table."""
    gaps: tuple[int, ...]
    """Frame gaps that models are trained and tested at; the paper's `skip` plus 1."""
    horizons: tuple[int, ...]
    """Predicted frames over which scores are averaged; the last is how far the models predict."""

    def contestants(self, gaps: tuple[int, ...] = ()) -> list[Contestant]:
        """Every model at every gap, those of the study or others."""
        return [Contestant(name, title, gap, args) for gap in gaps or self.gaps for name, title, args in self.models]


_NO_KNN = ("--losses.knn", "0")
_NO_SCENE = ("--losses.scene-smoothness", "0")
_NO_OPTICAL = ("--losses.optical-smoothness", "0")
_DETERMINISTIC = ("--model", "t3vip-d")  # without latents there is no KL
_ACTION_FREE = ("--architecture.no-act-cond",)

STUDIES: dict[StudyName, Study] = {
    "table": Study(
        "T3VIP against its 2D rivals",
        "Table I: how well does each model predict video, near and far ahead, with little and much motion a frame?",
        (
            ("cdna", "CDNA", ("--model", "cdna")),
            ("sna", "SNA", ("--model", "sna")),
            ("sv2p", "SV2P", ("--model", "sv2p")),
            ("t3vip", "T3VIP", ("--model", "t3vip")),
        ),
        gaps=(1, 3),
        horizons=(10, 30, 60),
    ),
    "ablation": Study(
        "What each term of the objective is worth",
        "Table II: M1 reconstructs only; M2 adds smooth scene flow; M3 has point cloud alignment instead; M4 has both; "
        "M5 adds smooth optical flow; M6 adds latents and their KL and is the full model.",
        (
            ("M1", "M1: reconstruction", (*_DETERMINISTIC, *_NO_KNN, *_NO_SCENE, *_NO_OPTICAL)),
            ("M2", "M2: M1 + scene smoothness", (*_DETERMINISTIC, *_NO_KNN, *_NO_OPTICAL)),
            ("M3", "M3: M1 + alignment", (*_DETERMINISTIC, *_NO_SCENE, *_NO_OPTICAL)),
            ("M4", "M4: M3 + scene smoothness", (*_DETERMINISTIC, *_NO_OPTICAL)),
            ("M5", "M5: M4 + optical smoothness", _DETERMINISTIC),
            ("M6", "M6: M5 + latents", ("--model", "t3vip")),
        ),
        gaps=(3,),
        horizons=(10, 20),
    ),
    "action-free": Study(
        "Prediction without actions",
        "The paper's figure of action-free prediction: models that do not see what the robot is told to do, with and "
        "without latents.",
        (
            ("sv2p", "SV2P", ("--model", "sv2p", *_ACTION_FREE)),
            ("t3vip-d", "T3VIP-D", ("--model", "t3vip-d", *_ACTION_FREE)),
            ("t3vip", "T3VIP", ("--model", "t3vip", *_ACTION_FREE)),
        ),
        gaps=(3,),
        horizons=(10, 20),
    ),
}
