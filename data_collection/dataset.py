"""Reading a dataset: a folder of shards as one set of flat columns."""

from __future__ import annotations

import hashlib
import itertools
import json
import math
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import h5py
import numpy as np
from numpy.typing import NDArray

from data_collection.attributes import check_attributes
from data_collection.schema import (
    COLUMNS,
    GROUND_TRUTH,
    MEANING,
    SHARD_PATTERN,
    Shard,
    dequantise_depth,
    read_shard,
    unreadable,
)
from envs.camera import CameraModel
from envs.errors import UsageError

NEARBY_ROWS = 32
"""Rows no farther apart are read in one go: they share a chunk, or lie in neighbouring ones."""


class RGBDDataset:
    """A folder of shards, checked when opened and read on demand.

    No file stays open between calls, so an instance can be pickled to a spawned process and used after a fork.

    Args:
        path: the dataset's folder.
        columns: the columns that will be read; None means all that the schema requires, and reading whatever is there.

    Raises:
        UsageError: the folder or a column is missing, a shard is damaged, its attributes do not fit its columns, or the
            shards do not belong together.
    """

    def __init__(self, path: str | Path, columns: Sequence[str] | None = None) -> None:
        self.path = Path(path)
        if not self.path.is_dir():
            raise UsageError(f"no dataset folder {self.path}; give one of collect-rollouts or import-dataset")
        paths = sorted(self.path.glob(SHARD_PATTERN))
        if not paths:
            raise UsageError(f"no {SHARD_PATTERN} in {self.path}; give a folder of collect-rollouts or import-dataset")
        self._shards = [read_shard(shard) for shard in paths]
        required = [name for name, column in COLUMNS.items() if column.required] if columns is None else list(columns)
        self.camera: CameraModel = _camera_of(self._shards[0])
        for shard in self._shards:
            self._check(shard, required)
        present = set.intersection(*(set(shard.columns) for shard in self._shards))
        self.columns: tuple[str, ...] = tuple(n for n in COLUMNS if n in present and (columns is None or n in columns))
        self.attrs: dict[str, Any] = self._shards[0].attrs
        self.has_ground_truth: bool = set(GROUND_TRUTH) <= set(self.columns)
        self.episode_lengths: NDArray[np.int64] = np.concatenate([shard.ep_len for shard in self._shards])

    def _check(self, shard: Shard, required: Sequence[str]) -> None:
        first = self._shards[0]
        for name in required:
            if name not in shard.columns:
                raise UsageError(
                    f"{shard.path} has no column '{name}' (it has {', '.join(shard.columns)}); "
                    f"use a dataset that has it, as collect-rollouts writes"
                    + (" with --ground-truth" if name in GROUND_TRUTH else "")
                )
        for name, row in shard.columns.items():
            if row != first.columns.get(name, row):
                raise UsageError(
                    f"column '{name}' has rows of {row} in {shard.path} but {first.columns[name]} in "
                    f"{first.path.name}; keep one dataset in a folder"
                )
        for name in MEANING:
            if shard.attrs[name] != first.attrs[name]:
                raise UsageError(
                    f"{shard.path} has {name} = {shard.attrs[name]!r} but {first.path.name} has "
                    f"{first.attrs[name]!r}; keep one dataset in a folder"
                )
        check_attributes(shard.attrs, shard.columns, self.camera, str(shard.path))

    def __len__(self) -> int:
        return len(self.episode_lengths)

    def __getitem__(self, number: int) -> dict[str, NDArray[Any]]:
        """As `episode`; negative numbers count from the end."""
        if not -self.episodes <= number < self.episodes:
            raise IndexError(f"episode {number} of a dataset of {self.episodes}")
        return self.episode(number % self.episodes)

    @property
    def episodes(self) -> int:
        """Number of episodes."""
        return len(self.episode_lengths)

    @property
    def files(self) -> list[Path]:
        """The shards, in order."""
        return [shard.path for shard in self._shards]

    @property
    def makers(self) -> list[dict[str, Any]]:
        """The different sets of program versions that made the shards; one where nothing changed in between."""
        makers: list[dict[str, Any]] = []
        for shard in self._shards:
            if shard.attrs["versions"] not in makers:
                makers.append(shard.attrs["versions"])
        return makers

    @property
    def action_dim(self) -> int:
        """Numbers in an action."""
        return self.width("action")

    def width(self, column: str) -> int:
        """Numbers in a row of a column that holds no pictures.

        Raises:
            UsageError: no such column.
        """
        self._require(column)
        return self._shards[0].columns[column][0]

    @property
    def episode_slices(self) -> NDArray[np.int64]:
        """(E, 2) first row and row past the last of each episode in the columns that `load` gives."""
        stops = np.cumsum(self.episode_lengths)
        return np.stack([stops - self.episode_lengths, stops], axis=1)

    @property
    def episode_indices(self) -> NDArray[np.int64]:
        """(E,) number of each episode in the run that collected it; gaps where episodes were dropped."""
        return np.concatenate([shard.ep_index for shard in self._shards])

    @property
    def episode_terminated(self) -> NDArray[np.bool_]:
        """(E,) whether each episode ended in a terminal state, as where a cube is dropped, before its steps were up."""
        return np.concatenate([shard.ep_terminated for shard in self._shards]).astype(bool)

    def load(self, column: str) -> NDArray[Any]:
        """A whole column of all shards, (N, ...), in its stored dtype.

        Raises:
            UsageError: no such column, or a shard is damaged.
        """
        self._require(column)
        rows = int(self.episode_lengths.sum())
        values = np.empty((rows, *self._shards[0].columns[column]), COLUMNS[column].dtype)
        start = 0
        for shard in self._shards:
            stop = start + shard.rows
            with _reading(shard) as file:
                file[column].read_direct(values, dest_sel=np.s_[start:stop])
            start = stop
        return values

    def size_of(self, columns: Sequence[str]) -> int:
        """Bytes that these columns take in memory.

        Raises:
            UsageError: no such column.
        """
        size = 0
        for name in columns:
            self._require(name)
            size += math.prod(self._shards[0].columns[name]) * np.dtype(COLUMNS[name].dtype).itemsize
        return size * int(self.episode_lengths.sum())

    def rows(self, columns: Sequence[str], rows: NDArray[np.int64]) -> dict[str, NDArray[Any]]:
        """Some rows of some columns, read from the shards by range: what lies far from them is not touched.

        Args:
            columns: names.
            rows: of any shape and in any order; numbers of rows in what `load` gives.

        Returns:
            name -> (*rows.shape, ...), in the stored dtype.

        Raises:
            UsageError: no such column, or a shard is damaged.
            IndexError: no such row.
        """
        for name in columns:
            self._require(name)
        wanted, places = np.unique(rows, return_inverse=True)
        stops = np.cumsum([shard.rows for shard in self._shards])
        if len(wanted) and not 0 <= wanted[0] <= wanted[-1] < stops[-1]:
            raise IndexError(f"rows {wanted[0]} to {wanted[-1]} of a dataset of {stops[-1]}")
        found = {name: np.empty((len(wanted), *self._shards[0].columns[name]), COLUMNS[name].dtype) for name in columns}
        stretches = np.flatnonzero(np.diff(wanted) > NEARBY_ROWS) + 1  # where one begins, beside those at shards' ends
        for number in np.unique(np.searchsorted(stops, wanted, side="right")):
            shard = self._shards[number]
            first, last = np.searchsorted(wanted, (stops[number] - shard.rows, stops[number]))
            local = wanted - (stops[number] - shard.rows)
            ends = [first, *stretches[(stretches > first) & (stretches < last)], last]
            with _reading(shard) as file:
                for here, there in itertools.pairwise(ends):
                    start, stop = local[here], local[there - 1] + 1
                    for name in columns:
                        found[name][here:there] = file[name][start:stop][local[here:there] - start]
        return {name: values[places.reshape(rows.shape)] for name, values in found.items()}

    def episode(self, number: int) -> dict[str, NDArray[Any]]:
        """All columns of one episode, (rows, ...) each, in their stored dtypes.

        Args:
            number: 0 .. episodes - 1.
        """
        if not 0 <= number < self.episodes:
            raise IndexError(f"episode {number} of a dataset of {self.episodes}")
        for shard in self._shards:
            if number < len(shard.ep_len):
                start = int(shard.ep_offset[number])
                stop = start + int(shard.ep_len[number])
                with _reading(shard) as file:
                    return {name: file[name][start:stop] for name in self.columns}
            number -= len(shard.ep_len)
        raise AssertionError("unreachable: lengths and shards agree")

    def stream(self, columns: Sequence[str]) -> Iterator[dict[str, NDArray[Any]]]:
        """Some columns of one episode after the other, (rows, ...) each, in their stored dtypes.

        Raises:
            UsageError: no such column, or a shard is damaged.
        """
        for name in columns:
            self._require(name)
        for shard in self._shards:
            for start, rows in zip(shard.ep_offset, shard.ep_len, strict=True):
                with _reading(shard) as file:
                    episode = {name: file[name][start : start + rows] for name in columns}
                yield episode

    def depth_metres(self, raw: NDArray[np.uint16]) -> NDArray[np.float32]:
        """Stored depth of any shape -> metres, float32."""
        return dequantise_depth(raw, self.camera.near, self.camera.far)

    @property
    def content_hash(self) -> str:
        """SHA-256 (hex) of what the data is: the episodes in order and the attributes that give them meaning.

        Does not depend on how the episodes are spread over shards, on compression, or on who collected them when.
        """
        digest = hashlib.sha256(json.dumps({name: self.attrs[name] for name in MEANING}, sort_keys=True).encode())
        for shard in self._shards:
            digest.update(np.ascontiguousarray(shard.ep_hash).data)
        return digest.hexdigest()

    def _require(self, column: str) -> None:
        if column not in self.columns:
            raise UsageError(f"no column '{column}' in {self.path}; it has {', '.join(self.columns)}")


def _camera_of(shard: Shard) -> CameraModel:
    try:
        return CameraModel.from_dict(shard.attrs["camera"])
    except UsageError as error:
        raise UsageError(f"{shard.path}: {error}") from error


class _reading:
    """A shard open for reading; what cannot be read is told as `unreadable` does."""

    def __init__(self, shard: Shard) -> None:
        self._shard = shard

    def __enter__(self) -> h5py.File:
        try:
            self._file = h5py.File(self._shard.path, "r")
        except OSError as error:
            raise unreadable(self._shard.path, error) from error
        return self._file

    def __exit__(self, kind: object, error: BaseException | None, trace: object) -> None:
        self._file.close()
        if isinstance(error, OSError | KeyError | RuntimeError):  # a KeyError: HDF5 does not find, or get to, a column
            raise unreadable(self._shard.path, error) from error
