"""Dropping what is damaged from a dataset, with the damaged files kept aside."""

from __future__ import annotations

import os
from pathlib import Path

from data_collection.attributes import FROM_CAMERA, complete_attributes
from data_collection.files import locked, remove_leftovers
from data_collection.schema import SHARD_PATTERN, DamagedShard
from data_collection.writer import intact_episodes, read_episode, write_shard
from envs.errors import UsageError

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
    episodes = [read_episode(shard, number) for number in kept]
    attrs = {name: value for name, value in shard.attrs.items() if name not in ("schema", *FROM_CAMERA)}
    if kept:
        complete_attributes(attrs, shard.columns)  # what cannot be written again is not moved
    aside = _move_aside(path)
    if kept:
        ended = [bool(shard.ep_terminated[number]) for number in kept]
        write_shard(path, episodes, attrs, [int(shard.ep_index[number]) for number in kept], ended)
    dropped = ", ".join(str(index) for index, whole in zip(shard.ep_index, intact, strict=True) if not whole)
    return [f"dropped episode {dropped} of {path.name}: checksum differs; kept as {aside}"]


def _move_aside(path: Path) -> Path:
    folder = path.parent / DAMAGED_FOLDER
    folder.mkdir(exist_ok=True)
    aside = folder / path.name
    number = 1
    while aside.exists():
        aside = folder / f"{path.name}.{number}"
        number += 1
    os.replace(path, aside)
    return aside.relative_to(path.parent)
