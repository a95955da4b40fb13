"""A dataset as one HDF5 file of flat columns, as `stable-worldmodel` reads them (its format hdf5).

pixels (N, H, W, 3) uint8, depth (N, H, W) float32 metres, and our other columns but for the ground truth
ep_len (E,), ep_offset (E,): rows and first row of each episode
attributes: those of our shards
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import h5py
import numpy as np
from numpy.typing import NDArray

from data_collection.dataset import RGBDDataset
from data_collection.schema import COLUMNS, GROUND_TRUTH, encode_attributes
from envs.errors import UsageError
from envs.files import written_aside

CHUNK_BYTES = 1 << 18


def export_flat_file(dataset: RGBDDataset, path: Path, on_episode: Callable[[], object] = lambda: None) -> None:
    """Write the file, whole or not at all.

    Args:
        dataset: what to export, read episode by episode.
        path: of the file.
        on_episode: called after every episode.

    Raises:
        UsageError: the file is there already.
    """
    if path.exists():
        raise UsageError(f"{path} is there already; give another --out, or remove it")
    path.parent.mkdir(parents=True, exist_ok=True)
    slices = dataset.episode_slices
    rows = int(dataset.episode_lengths.sum())
    # Their reader opens files for concurrent reading (SWMR), which needs a format of at least 1.10.
    with written_aside(path) as aside, h5py.File(aside, "w", libver=("v110", "v110")) as file:
        for name, value in encode_attributes(dataset.attrs).items():
            file.attrs[name] = value
        file["ep_len"] = dataset.episode_lengths
        file["ep_offset"] = slices[:, 0]
        for number, (start, stop) in enumerate(slices):
            for name, values in _columns(dataset, number).items():
                if name not in file:
                    frames = int(np.clip(CHUNK_BYTES // max(1, values[:1].nbytes), 1, rows))
                    shape = values.shape[1:]
                    chunks = (frames, *shape)
                    file.create_dataset(name, (rows, *shape), values.dtype, chunks=chunks, compression="lzf")
                file[name][start:stop] = values
            on_episode()


def _columns(dataset: RGBDDataset, number: int) -> dict[str, NDArray[Any]]:
    stored = dataset.episode(number)
    columns = {name: stored[name] for name in COLUMNS if name in stored and name not in GROUND_TRUTH}
    columns["pixels"] = columns.pop("rgb")
    columns["depth"] = dataset.depth_metres(columns["depth"])
    return columns
