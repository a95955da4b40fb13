"""Writing shards: whole or not at all.

The collector writes one shard per episode, `shard-00007.h5` for episode 7, so that a killed process costs at most the
episode in flight, resuming means looking which files are there, and nothing depends on the number of workers. Readers
take any number of episodes a shard.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import h5py
import numpy as np
from numpy.typing import NDArray

from data_collection.attributes import complete_attributes
from data_collection.schema import (
    COLUMNS,
    DamagedShard,
    Shard,
    encode_attributes,
    episode_hash,
    read_shard,
    unreadable,
)
from envs.errors import UsageError
from envs.files import written_aside

CHUNK_BYTES = 1 << 19  # a chunk is a run of frames of one clip; half a megabyte stays in the cache while it is unpacked


def shard_path(folder: Path, episode: int) -> Path:
    """Where the collector puts an episode."""
    return folder / f"shard-{episode:05d}.h5"


def write_shard(
    path: Path,
    episodes: Sequence[Mapping[str, NDArray[Any]]],
    attrs: Mapping[str, Any],
    ep_index: Sequence[int],
    ep_terminated: Sequence[bool] = (),
) -> None:
    """Write episodes into one shard, atomically.

    Args:
        path: of the shard; a file that is there is replaced.
        episodes: for each its columns as the schema has them, (rows, ...) each; the same columns in all.
        attrs: the attributes as Python values, `camera` as its `to_dict` gives it; without `schema`, and without what
            follows from the camera (`K`, `world_T_camera`, `near`, `far`).
        ep_index: number of each episode in its run.
        ep_terminated: whether each episode ended in a terminal state; none did if not given.

    Raises:
        ValueError: a column is not what the schema says.
        UsageError: there are no episodes, a table is not as long as they are many, or an attribute is missing or does
            not fit the columns.
    """
    if not episodes:
        raise UsageError(f"no episodes for {path.name}; give one or more, and write no shard where there are none")
    ended = list(ep_terminated) or [False] * len(episodes)
    for name, given in (("ep_index", ep_index), ("ep_terminated", ended)):
        if len(given) != len(episodes):
            raise UsageError(f"{name} has {len(given)} for {len(episodes)} episodes; give one for each")
    for columns in episodes:
        _check(columns, episodes[0])
    complete = complete_attributes(attrs, {name: values.shape[1:] for name, values in episodes[0].items()})
    lengths = np.array([len(columns["action"]) for columns in episodes], np.int64)
    tables = {
        "ep_len": lengths,
        "ep_offset": np.cumsum(lengths) - lengths,
        "ep_index": np.asarray(ep_index, np.int64),
        "ep_hash": np.stack([episode_hash(columns) for columns in episodes]),
    }
    if any(ended):
        tables["ep_terminated"] = np.array(ended, np.uint8)
    with written_aside(path) as aside, h5py.File(aside, "w", libver=("v110", "v110")) as file:
        for name, values in encode_attributes(complete).items():
            file.attrs[name] = values
        for name, table in tables.items():
            file.create_dataset(name, data=table)
        for name in episodes[0]:
            values = np.concatenate([columns[name] for columns in episodes])
            # The camera stands still, so deflate finds the last frame's background in its window: an eighth of the
            # size, unpacked faster than lzf. Its checksum catches damaged chunks.
            file.create_dataset(name, data=values, chunks=_chunk(values), compression="gzip", compression_opts=1)


def read_episode(shard: Shard, number: int) -> dict[str, NDArray[Any]]:
    """One episode of a shard with all its columns, as `write_shard` takes it."""
    start = int(shard.ep_offset[number])
    stop = start + int(shard.ep_len[number])
    with h5py.File(shard.path, "r") as file:
        return {name: file[name][start:stop] for name in shard.columns}


def intact_episodes(path: Path) -> tuple[Shard, list[bool]]:
    """Read a shard to the last byte and say of each episode whether it is the one that was written.

    Raises:
        DamagedShard: the shard does not open.
        UsageError: the system does not let it be read.
    """
    shard = read_shard(path)
    return shard, [_is_intact(shard, number) for number in range(len(shard.ep_len))]


def _is_intact(shard: Shard, number: int) -> bool:
    try:
        return bool(np.array_equal(episode_hash(read_episode(shard, number)), shard.ep_hash[number]))
    except (OSError, KeyError, RuntimeError) as error:  # a chunk that does not unpack
        told = unreadable(shard.path, error)
        if not isinstance(told, DamagedShard):
            raise told from error
        return False


def _chunk(values: NDArray[Any]) -> tuple[int, ...]:
    row_bytes = max(1, values[:1].nbytes)
    return (int(np.clip(CHUNK_BYTES // row_bytes, 1, len(values))), *values.shape[1:])


def _check(columns: Mapping[str, NDArray[Any]], first: Mapping[str, NDArray[Any]]) -> None:
    missing = [name for name, column in COLUMNS.items() if column.required and name not in columns]
    if missing:
        raise ValueError(f"an episode without column '{missing[0]}'")
    if columns.keys() != first.keys():
        raise ValueError(f"episodes of one shard with different columns: {sorted(columns)} and {sorted(first)}")
    rows = len(columns["action"])
    if not rows:
        raise ValueError("an episode without rows; one of T actions has T + 1")
    for name, values in columns.items():
        expected = COLUMNS.get(name)
        if expected is None:
            raise ValueError(f"unknown column '{name}'; the schema has {', '.join(COLUMNS)}")
        if str(values.dtype) != expected.dtype or values.ndim != expected.ndim or len(values) != rows:
            raise ValueError(
                f"column '{name}' is {values.dtype} {values.shape}, not {rows} rows of {expected.dtype} "
                f"with {expected.ndim} axes"
            )
        if values.dtype.kind == "f" and not np.isfinite(values).all():
            raise ValueError(f"column '{name}' has values that are not finite")
