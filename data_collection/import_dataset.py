"""`import-dataset`: somebody else's recordings, in a public layout, as a dataset."""

from __future__ import annotations

import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal

import tyro
from tqdm import tqdm

from data_collection.environments import versions
from data_collection.importers import Source, SourceOptions, open_source
from data_collection.importers.crew import import_parts
from data_collection.importers.report import Report, check_continues, read_finished
from envs.command import end_on_sigterm, run
from envs.errors import UsageError
from envs.files import locked, remove_leftovers


@dataclass(frozen=True)
class Config:
    """Import RGB-D recordings into a dataset folder. The same command on the same folder goes on where it stopped.

    A damaged episode is skipped and named, there and in DST/import.json; the next run tries it again.
    """

    source: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="SRC")]
    """Folder to import from: a dataset in its public layout, or one of its splits."""
    out: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="DST")]
    """Folder of the dataset; made if it is not there."""
    format: Literal["calvin", "omnipush", "dexhand"]
    """Whose layout SRC has."""
    split: str | None = None
    """Which split, where SRC has several; the training split when not given."""
    image_size: int = 64
    """Height and width of the images, pixels; a multiple of 8 for the world model."""
    near: float | None = None
    """Least depth that is stored, metres; by default that of the format."""
    far: float | None = None
    """Greatest depth that is stored, metres; by default that of the format."""
    depth_scale: float = 1.0
    """Multiply the depth of SRC by this, where its unit is not the format's."""
    steps: int = 240
    """Most actions in an episode; longer play (CALVIN) is cut into equal pieces."""
    limit: int | None = None
    """Import only the first so many episodes; a larger number goes on."""
    scene: str | None = None
    """CALVIN: name of the scene, if the folder does not tell."""
    ids: Path | None = None
    """CALVIN: a table of first and last frames in place of SRC's ep_start_end_ids.npy."""
    workers: int = 2
    """Processes that import."""
    strict: bool = False
    """End with exit code 2 if an episode is damaged."""

    def __post_init__(self) -> None:
        for name, least in (("image_size", 8), ("steps", 1), ("workers", 1), ("limit", 1)):
            value = getattr(self, name)
            if value is not None and value < least:
                option = name.replace("_", "-")
                raise UsageError(f"--{option} is {value}; give a whole number of at least {least}")
        for name in ("near", "far", "depth_scale"):
            value = getattr(self, name)
            if value is not None and not 0 < value < float("inf"):
                raise UsageError(f"--{name.replace('_', '-')} is {value}; give a positive number")
        if self.format != "calvin" and (self.scene is not None or self.ids is not None):
            option = "--scene" if self.scene is not None else "--ids"
            raise UsageError(f"{option} is for CALVIN, not for {self.format}; leave it out")
        if self.out.exists() and not self.out.is_dir():
            raise UsageError(f"{self.out} is a file; give a folder to import into")

    def options(self) -> SourceOptions:
        return SourceOptions(
            path=self.source,
            split=self.split,
            image_size=self.image_size,
            near=self.near,
            far=self.far,
            depth_scale=self.depth_scale,
            steps=self.steps,
            scene=self.scene,
            ids=self.ids,
        )


def main(config: Config) -> None:
    """Import the episodes that the dataset does not have yet."""
    source = open_source(config.format, config.options())
    parts = source.parts()
    wanted = parts[: config.limit]
    folder = config.out
    report = Report(_content(config, source), str(config.source), len(parts), source.notes)
    folder.mkdir(parents=True, exist_ok=True)
    with locked(folder):
        check_continues(report.options, folder)
        remove_leftovers(folder)
        report.outcomes |= read_finished(folder, parts)
        report.save(folder, complete=False)
        missing = [part for part in wanted if part.index not in report.outcomes]
        done = len(wanted) - len(missing)
        try:
            with tqdm(total=len(wanted), initial=done, unit="episode", desc=folder.name, file=sys.stderr) as progress:
                for outcome in import_parts(source, describe(source), folder, missing, config.workers):
                    report.outcomes[outcome.index] = outcome
                    if outcome.damage is not None:
                        progress.write(outcome.line(), file=sys.stderr)
                    progress.update()
        except BaseException:
            remove_leftovers(folder)
            report.save(folder, complete=False)
            raise
        report.save(folder, complete=True)
    print(report.summary(folder))
    if not report.imported:
        raise UsageError(f"no episode of {config.source} could be imported; the lines above say why")
    if config.strict and report.damaged:
        raise UsageError(f"{len(report.damaged)} of {len(wanted)} episodes are damaged; mend them and run again")


def describe(source: Source) -> dict[str, Any]:
    """The attributes of a shard that follow from the source."""
    return {
        "env_id": source.env_id,
        "env_kwargs": {"split": source.split} if source.split else {},
        "policy": "recorded",
        "seed": 0,
        "control_rate": source.control_rate,
        "camera": source.camera.to_dict(),
        "action_aggregation": list(source.action_aggregation),
        "action_scale": list(source.action_scale),
        "body_names": [],
        "hand_body_ids": [],
        "versions": versions(),
        "gl_renderer": "unknown",
    }


def _content(config: Config, source: Source) -> dict[str, Any]:
    """What fixes the content of every episode, whatever the number of workers and however many are asked for."""
    return {
        "format": config.format,
        "env_id": source.env_id,
        "split": source.split,
        "camera": source.camera.to_dict(),
        "action_aggregation": list(source.action_aggregation),
        "depth_scale": config.depth_scale,
        "steps": config.steps,
    }


def command() -> None:
    end_on_sigterm("run the same command again to go on")
    run(Config, main)
