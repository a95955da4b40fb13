"""What an importer is asked for: the parts of somebody else's dataset, each to become an episode of ours."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from envs.camera import CameraModel
from envs.errors import UsageError

Columns = dict[str, NDArray[Any]]
SPLITS = ("training", "train", "validation", "val", "test")
"""Names that the public layouts give the folders of their splits; where none is asked for, the first there is taken."""


class Damaged(Exception):
    """A part that cannot become an episode; the message says in one line why, and is no error of the whole import."""


@dataclass(frozen=True)
class Part:
    """What becomes one episode."""

    index: int
    """Its number in the dataset to be."""
    name: str
    """What it is in the source, in words, without the path of the source."""
    folder: Path
    """Where its files are."""
    first: int = 0
    """Number of its first frame, where the layout numbers frames throughout."""
    frames: int = 0
    """How many frames it has; 0 where only reading tells."""


@dataclass(frozen=True)
class Episode:
    """A part that was read and found whole."""

    columns: Columns
    """The columns of the schema, (rows, ...) each."""
    notes: tuple[str, ...] = ()
    """What is odd about it, a line each."""


@dataclass(frozen=True)
class SourceOptions:
    """How to read a source; what is None follows from the format."""

    path: Path
    """Folder of the source, or of one of its splits."""
    split: str | None = None
    image_size: int = 64
    """Height and width of the pictures to be, pixels."""
    near: float | None = None
    far: float | None = None
    """Depth range of the dataset to be, metres."""
    depth_scale: float = 1.0
    """Stored depth times this is what the format says it should be."""
    steps: int = 240
    """Longest episode to be, in actions."""
    scene: str | None = None
    """CALVIN: name of the scene."""
    ids: Path | None = None
    """CALVIN: another table of episodes."""


class Source(Protocol):
    """A folder in a public layout, open for reading; travels to worker processes."""

    @property
    def env_id(self) -> str:
        """Name of the world that the data comes from."""

    @property
    def control_rate(self) -> float:
        """Frames per second."""

    @property
    def camera(self) -> CameraModel:
        """The camera of the pictures to be."""

    @property
    def action_aggregation(self) -> tuple[str, ...]:
        """How each number of an action adds up over a frame gap."""

    @property
    def action_scale(self) -> tuple[float, ...]:
        """What one unit of each number of an action is, in metres or radians."""

    @property
    def split(self) -> str:
        """Name of the split; empty if the source has none."""

    @property
    def notes(self) -> tuple[str, ...]:
        """What is odd about the source as a whole, a line each."""

    def parts(self) -> Sequence[Part]:
        """All parts in their order, without reading them."""

    def read(self, part: Part) -> Episode:
        """Read and check one part; holds no more than that part in memory, at the size of the pictures to be.

        Raises:
            Damaged: it is not what the layout says.
        """


def find_split(path: Path, asked: str | None) -> tuple[Path, str]:
    """The folder to read, and its name.

    Args:
        path: of the source or of a split.
        asked: name of the split; None for the first of `SPLITS` that is there, or `path` itself if none is.

    Raises:
        UsageError: no such folder or split.
    """
    if not path.is_dir():
        raise UsageError(f"no folder {path} to import from; give the folder that holds the dataset")
    there = [name for name in SPLITS if (path / name).is_dir()]
    if asked is None:
        return (path / there[0], there[0]) if there else (path, path.name if path.name in SPLITS else "")
    if not (path / asked).is_dir():
        has = f"it has {', '.join(there)}" if there else "it has none; leave out --split"
        raise UsageError(f"{path} has no split '{asked}'; {has}")
    return path / asked, asked


def actions_of_episode(actions: NDArray[Any]) -> NDArray[np.float32]:
    """Actions (T, A) -> the column (T+1, A): the last row, after which nothing was done, is zero."""
    return np.concatenate([actions, np.zeros_like(actions[:1])]).astype(np.float32)
