"""Importing CALVIN's layout, beside unpacking alone what the import reads of it."""

from __future__ import annotations

import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np

from data_collection.import_dataset import describe
from data_collection.importers import SourceOptions, open_source
from data_collection.importers.crew import import_part
from tests.benchmarks.timing import peak_mebibytes
from tests.data_collection.layouts import calvin_frame, write_calvin

READ = ("rgb_static", "depth_static", "rel_actions", "robot_obs", "scene_obs")
FRAMES = 241  # of an episode: 240 actions


def import_speed(frames: int, size: int) -> dict[str, float]:
    """Import and unpack every file in turn.

    Returns:
        "gigabytes" of the files, and how many of them a second the "import" takes in, and to "unpack" the same arrays
        alone.
    """
    with _recording(frames, size) as (folder, out):
        files = sorted(folder.glob("episode_*.npz"))
        gigabytes = sum(file.stat().st_size for file in files) / 1e9
        began = time.perf_counter()
        for file in files:
            with np.load(file) as frame:
                for key in READ:
                    frame[key]
        unpacked = time.perf_counter()
        _import(folder, out)
        done = time.perf_counter()
    return {"gigabytes": gigabytes, "import": gigabytes / (done - unpacked), "unpack": gigabytes / (unpacked - began)}


def import_mebibytes(frames: int, size: int) -> float:
    """MiB that an import takes at its peak."""
    with _recording(frames, size) as (folder, out):
        return peak_mebibytes(lambda: _import(folder, out))


def _import(folder: Path, out: Path) -> None:
    """What one process of `import-dataset` does, part by part."""
    source = open_source("calvin", SourceOptions(folder, steps=FRAMES - 1))
    out.mkdir(exist_ok=True)
    for part in source.parts():
        outcome = import_part(source, describe(source), out, part)
        if outcome.damage is not None:
            raise RuntimeError(outcome.line())


@contextmanager
def _recording(frames: int, size: int) -> Iterator[tuple[Path, Path]]:
    """A folder in CALVIN's layout whose pictures hardly compress, and a place for the dataset."""
    with tempfile.TemporaryDirectory() as name:
        folder = write_calvin(Path(name) / "task_D_D", [(0, 1)], size=size)
        rng = np.random.default_rng(0)
        for number in range(frames):
            frame = calvin_frame(number, rng, size)
            frame["rgb_static"] = rng.integers(0, 256, (size, size, 3), np.uint8)
            frame["depth_static"] += rng.uniform(-0.05, 0.05, (size, size)).astype(np.float32)
            np.savez_compressed(folder / f"episode_{number:07d}.npz", **frame)
        np.save(folder / "ep_start_end_ids.npy", np.array([[0, frames - 1]]))
        (folder / "ep_lens.npy").unlink()
        yield folder, Path(name) / "data"
