"""`export-dataset`: a dataset in the format of another project."""

from __future__ import annotations

import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

import tyro
from tqdm import tqdm

from data_collection.dataset import RGBDDataset
from data_collection.exporters.flat_file import export_flat_file
from data_collection.exporters.minari_dataset import export_minari
from envs.command import end_on_sigterm, run
from envs.errors import UsageError


@dataclass(frozen=True)
class Config:
    """Write a dataset in the format of another project; it is there whole or not at all."""

    path: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="DIR")]
    """The dataset's folder."""
    to: Literal["minari", "stable-worldmodel"]
    """minari: a local Minari dataset. stable-worldmodel: one HDF5 file of flat columns."""
    name: str | None = None
    """Minari: the id of the dataset, (namespace/)name-v0."""
    out: Path | None = None
    """Minari: folder of Minari datasets, its own when not given. stable-worldmodel: the file."""
    author: str | None = None
    """Minari: author of the data."""

    def __post_init__(self) -> None:
        if self.to == "minari" and self.name is None:
            raise UsageError("no --name; give Minari's id of the dataset, like tabletop/play-c-v0")
        if self.to == "stable-worldmodel":
            if self.out is None:
                raise UsageError("no --out; give the file to write, like c.h5")
            for option in ("name", "author"):
                if getattr(self, option) is not None:
                    raise UsageError(f"--{option} is for Minari; leave it out")


def main(config: Config) -> None:
    """Export episode by episode."""
    dataset = RGBDDataset(config.path)
    with tqdm(total=dataset.episodes, unit="episode", desc=config.to, file=sys.stderr) as progress:
        if config.to == "minari":
            assert config.name is not None
            written = export_minari(dataset, config.name, config.out, config.author, progress.update)
        else:
            assert config.out is not None
            written = config.out
            export_flat_file(dataset, written, progress.update)
    print(f"{dataset.episodes} episodes in {written}")


def command() -> None:
    end_on_sigterm("nothing was written")
    run(Config, main)
