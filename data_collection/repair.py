"""Dropping what is damaged from a dataset, with the damaged files kept aside."""

from __future__ import annotations

import os
import shutil
from pathlib import Path

from data_collection.attributes import FROM_CAMERA
from data_collection.schema import SHARD_PATTERN, DamagedShard, Shard
from data_collection.writer import intact_episodes, read_episode, write_shard
from envs.errors import UsageError
from envs.files import locked, remove_leftovers, written_aside

DAMAGED_FOLDER = "damaged"


def find_damage(folder: Path) -> list[str]:
    """Read every byte of a dataset; one line for each damaged shard or episode, none if all is well."""
    damage = []
    for path in sorted(folder.glob(SHARD_PATTERN)):
        try:
            shard, intact = intact_episodes(path)
        except DamagedShard as error:
            damage.append(str(error))
            continue
        damage += [
            f"{path}: episode {index} is not what was written (checksum)"
            for index, whole in zip(shard.ep_index, intact, strict=True)
            if not whole
        ]
    return damage


def repair(folder: Path) -> list[str]:
    """Move damaged shards into `folder/damaged`; the intact episodes of such a shard are written again.

    Whenever it is killed, and whatever fails, each intact episode is in a shard of the folder.

    Returns:
        one line for each thing done; `collect-rollouts` makes dropped episodes again.

    Raises:
        UsageError: the folder is missing or has no shards, a collector is writing to it, the system does not let a
            shard be read, or a shard is whole but its writer left out attributes or gave some that do not fit.
    """
    if not folder.is_dir():
        raise UsageError(f"no dataset folder {folder}; give the folder that collect-rollouts wrote")
    if not any(folder.glob(SHARD_PATTERN)):
        raise UsageError(f"no {SHARD_PATTERN} in {folder}; give the folder that collect-rollouts wrote")
    with locked(folder):
        report = [f"removed {name}, left by a killed writer" for name in remove_leftovers(folder)]
        for path in sorted(folder.glob(SHARD_PATTERN)):
            report += _repair_shard(path)
    return report


def _repair_shard(path: Path) -> list[str]:
    try:
        shard, intact = intact_episodes(path)
    except DamagedShard as error:
        return [f"dropped all of {path.name}: {error.reason}; kept as {_move_aside(path)}"]
    if all(intact):
        return []
    kept = [number for number, whole in enumerate(intact) if whole]
    aside = _rewrite(shard, kept) if kept else _move_aside(path)
    dropped = ", ".join(str(index) for index, whole in zip(shard.ep_index, intact, strict=True) if not whole)
    return [f"dropped episode {dropped} of {path.name}: checksum differs; kept as {aside}"]


def _rewrite(shard: Shard, kept: list[int]) -> Path:
    """Put a shard of these episodes in the place of a damaged one; where that one is kept, relative to the dataset."""
    attrs = {name: value for name, value in shard.attrs.items() if name not in ("schema", *FROM_CAMERA)}
    with written_aside(shard.path) as path:
        write_shard(
            path,
            [read_episode(shard, number) for number in kept],
            attrs,
            [int(shard.ep_index[number]) for number in kept],
            [bool(shard.ep_terminated[number]) for number in kept],
        )
        return _copy_aside(shard.path)


def _copy_aside(path: Path) -> Path:
    """Give a damaged shard a second name, so that it has its own one until another shard takes that."""
    aside = _name_aside(path)
    try:
        aside.hardlink_to(path)
    except OSError:  # a file system without hard links
        with written_aside(aside) as copy:
            shutil.copyfile(path, copy)
    return aside.relative_to(path.parent)


def _move_aside(path: Path) -> Path:
    aside = _name_aside(path)
    os.replace(path, aside)
    return aside.relative_to(path.parent)


def _name_aside(path: Path) -> Path:
    """A free name for a damaged shard, in the folder for such."""
    folder = path.parent / DAMAGED_FOLDER
    folder.mkdir(exist_ok=True)
    aside = folder / path.name
    number = 1
    while aside.exists():
        aside = folder / f"{path.name}.{number}"
        number += 1
    return aside
