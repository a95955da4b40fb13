"""What a shard holds: columns, episode tables and attributes, and the checks made when one is opened.

shard-00007.h5
  rgb          (N, H, W, 3)    uint8
  depth        (N, H, W)       uint16   quantised over [near, far], see `quantise_depth`
  action       (N, A)          float32  row t: executed between frame t and t+1; zeros in an episode's last row
  proprio      (N, P)          float32
  state        (N, S)          float64  the simulator's full state
  reward       (N,)            float32  row t: earned by action t; zero in an episode's last row
  scene_obs    (N, O)          float32  optional: what the fixtures and objects do
  joint_delta  (N, J)          float32  optional: row t: how far each joint went by action t, rad; zeros in the last row
  segmentation (N, H, W)       uint8    optional: body ids, 0 = background
  body_pose    (N, nbody, 7)   float32  optional: world position, unit quaternion wxyz
  ep_len       (E,)            int64    rows of each episode: its actions + 1
  ep_offset    (E,)            int64    first row of each episode
  ep_index     (E,)            int64    number of the episode in its run; with the run's seed it fixes the episode
  ep_hash      (E, 32)         uint8    SHA-256 of the episode's columns
  ep_terminated (E,)           uint8    optional: 1 where an episode ended in a terminal state; none did without it
  attributes: numbers and JSON strings, `ATTRIBUTES`

Whatever else somebody has put into the file is theirs: it is not looked at, and no sign of damage.
"""

from __future__ import annotations

import errno
import hashlib
import json
import os
import re
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import h5py
import numpy as np
from numpy.typing import NDArray

from envs.depth import clipped_depth
from envs.errors import UsageError

SCHEMA_VERSION = 1
SHARD_PATTERN = "shard-*.h5"
ERRNO = re.compile(r"errno = (\d+)")  # in what HDF5 says, of errors that are not its own
ABOUT_CONTENT = (errno.EINVAL, errno.EOVERFLOW)  # a damaged file may send its reader to places that no file has
DEPTH_STEPS = 65535  # the largest uint16


@dataclass(frozen=True)
class Column:
    """How a column is stored: dtype, and number of axes with that of the rows."""

    dtype: str
    ndim: int
    required: bool = True


COLUMNS: dict[str, Column] = {
    "rgb": Column("uint8", 4),
    "depth": Column("uint16", 3),
    "action": Column("float32", 2),
    "proprio": Column("float32", 2),
    "state": Column("float64", 2),
    "reward": Column("float32", 1),
    "scene_obs": Column("float32", 2, required=False),
    "joint_delta": Column("float32", 2, required=False),
    "segmentation": Column("uint8", 3, required=False),
    "body_pose": Column("float32", 3, required=False),
}
GROUND_TRUTH = ("segmentation", "body_pose")
EPISODE_TABLES = ("ep_len", "ep_offset", "ep_index", "ep_hash")
OPTIONAL_TABLE = "ep_terminated"
TABLE_ROWS = {"ep_hash": (32,)}
"""What a table has for an episode, where that is more than a number."""

NUMBERS = ("schema", "seed", "control_rate", "K", "world_T_camera", "near", "far")
JSON_STRINGS = (
    "env_id",
    "env_kwargs",
    "policy",
    "camera",
    "action_aggregation",
    "action_scale",
    "body_names",
    "hand_body_ids",
    "versions",
    "gl_renderer",
)
ATTRIBUTES = NUMBERS + JSON_STRINGS
MEANING = ("schema", "env_id", "env_kwargs", "control_rate", "camera", "action_aggregation", "action_scale")
"""The attributes without which the columns mean something else; equal in all shards of a dataset."""


class DamagedShard(UsageError):
    """A shard that cannot be read; `inspect-dataset DIR --repair` moves it aside."""

    def __init__(self, path: Path, reason: str) -> None:
        self.reason = reason
        super().__init__(f"{path} is damaged ({reason}); drop it with: inspect-dataset {path.parent} --repair")


@dataclass(frozen=True, eq=False)
class Shard:
    """A shard's tables and attributes, read once; no file is held open."""

    path: Path
    columns: dict[str, tuple[int, ...]]
    """name -> shape of one row"""
    ep_len: NDArray[np.int64]
    ep_offset: NDArray[np.int64]
    ep_index: NDArray[np.int64]
    ep_hash: NDArray[np.uint8]
    ep_terminated: NDArray[np.uint8]
    attrs: dict[str, Any]

    @property
    def rows(self) -> int:
        return int(self.ep_len.sum())


def quantise_depth(metres: NDArray[Any], near: float, far: float) -> NDArray[np.uint16]:
    """Depth in metres, any shape -> uint16 over [near, far], clipped to it.

    Raises:
        UsageError: it is no depth in metres, or has holes; see `clipped_depth`.
    """
    unit = (clipped_depth(metres, near, far) - near) / (far - near)
    return np.rint(unit * DEPTH_STEPS).astype(np.uint16)


def dequantise_depth(raw: NDArray[np.uint16], near: float, far: float) -> NDArray[np.float32]:
    """uint16 over [near, far], any shape -> depth in metres, float32; off by half a quantisation step at most."""
    metres = raw.astype(np.float32)
    metres *= np.float32((far - near) / DEPTH_STEPS)
    metres += np.float32(near)
    return metres


def encode_attributes(attrs: Mapping[str, Any]) -> dict[str, Any]:
    """Python values -> numbers and JSON strings, as HDF5 stores them."""
    return {
        name: np.asarray(value) if name in NUMBERS or isinstance(value, np.ndarray) else json.dumps(value)
        for name, value in attrs.items()
    }


def episode_hash(columns: Mapping[str, NDArray[Any]]) -> NDArray[np.uint8]:
    """SHA-256 over an episode's columns (names, shapes, stored bytes), in the order of the schema -> (32,) uint8."""
    digest = hashlib.sha256()
    for name in (name for name in COLUMNS if name in columns):
        values = np.ascontiguousarray(columns[name])
        digest.update(f"{name}{values.shape}{values.dtype}".encode())
        digest.update(values.data)
    return np.frombuffer(digest.digest(), np.uint8)


def read_shard(path: Path) -> Shard:
    """Read and check a shard's tables and attributes; the columns' values are left alone.

    Raises:
        DamagedShard: HDF5 makes nothing of it, or its tables and columns are missing or disagree.
        UsageError: the system does not let it be read, or it was written in another version of the schema, or without
            an attribute.
    """
    try:
        with h5py.File(path, "r") as file:
            attrs = _read_attributes(path, file)
            named = set(file)
            stored = {name: file[name] for name in (*EPISODE_TABLES, OPTIONAL_TABLE, *COLUMNS) if name in named}
            groups = [name for name, found in stored.items() if not isinstance(found, h5py.Dataset)]
            if groups:
                raise DamagedShard(path, f"'{groups[0]}' holds no values")
            tables = {name: np.asarray(stored[name][()]) for name in EPISODE_TABLES if name in stored}
            terminated = np.asarray(stored[OPTIONAL_TABLE][()]) if OPTIONAL_TABLE in stored else None
            columns = {name: (stored[name].shape or (), str(stored[name].dtype)) for name in COLUMNS if name in stored}
    except (OSError, KeyError, RuntimeError, ValueError) as error:
        if isinstance(error, UsageError):
            raise
        raise unreadable(path, error) from error
    for name in EPISODE_TABLES:
        if name not in tables:
            raise DamagedShard(path, f"no table '{name}'")
    episodes = np.size(tables["ep_len"])
    terminated = np.zeros(episodes, np.uint8) if terminated is None else terminated
    for name, table in {**tables, OPTIONAL_TABLE: terminated}.items():
        if table.shape != (episodes, *TABLE_ROWS.get(name, ())) or table.dtype.kind not in "iu":
            raise DamagedShard(path, f"{name} is {table.dtype} {table.shape}, for {episodes} episodes")
    rows = int(tables["ep_len"].sum())
    if not np.array_equal(np.cumsum(tables["ep_len"]) - tables["ep_len"], tables["ep_offset"]):
        raise DamagedShard(path, "ep_offset does not follow from ep_len")
    for name, (shape, dtype) in columns.items():
        expected = COLUMNS[name]
        if dtype != expected.dtype or len(shape) != expected.ndim:
            wanted = f"{expected.dtype} of {expected.ndim} axes"
            raise DamagedShard(path, f"column '{name}' is {dtype} {shape}, not {wanted}")
        if shape[:1] != (rows,):
            raise DamagedShard(path, f"column '{name}' has {shape[0] if shape else 0} rows, its episodes {rows}")
    rest = {name: shape[1:] for name, (shape, _) in columns.items()}
    return Shard(path, rest, **tables, ep_terminated=terminated, attrs=attrs)


def unreadable(path: Path, error: Exception) -> UsageError:
    """What to raise where a shard cannot be read: a `DamagedShard` only if it is the content that HDF5 cannot read.

    A shard without permission, one that another program has locked, or one file too many may well be whole.
    """
    told = ERRNO.search(str(error))
    number = getattr(error, "errno", None) or (int(told[1]) if told else None)
    if number is None or number in ABOUT_CONTENT:
        return DamagedShard(path, _first_line(error))
    return UsageError(f"{path} cannot be read: {os.strerror(number)}; mend that and try again, it may well be whole")


def _read_attributes(path: Path, file: h5py.File) -> dict[str, Any]:
    if "schema" not in file.attrs:
        raise UsageError(f"{path} has no attribute 'schema': it is no shard of this project; take it out of the folder")
    version = int(file.attrs["schema"])
    if version != SCHEMA_VERSION:
        raise UsageError(
            f"{path} has schema version {version}, this program reads {SCHEMA_VERSION}; "
            "collect the dataset again, or use the program version that wrote it"
        )
    attrs = {name: _decode(name, value) for name, value in file.attrs.items() if _is_plain(value)}
    missing = [name for name in ATTRIBUTES if name not in attrs]
    if missing:
        raise UsageError(f"{path} has no attribute '{missing[0]}'; write it with all that docs/data.md lists")
    return attrs


def _is_plain(value: Any) -> bool:
    return isinstance(value, str) or np.asarray(value).dtype.kind in "biuf"


def _decode(name: str, value: Any) -> Any:
    if not isinstance(value, str):
        return value.item() if np.ndim(value) == 0 else np.asarray(value)
    try:
        return json.loads(value)
    except ValueError:
        if name in ATTRIBUTES:
            raise
        return value  # somebody else's words


def _first_line(error: BaseException) -> str:
    return str(error).strip().splitlines()[0] if str(error).strip() else type(error).__name__
