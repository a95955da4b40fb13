"""Pictures of a dataset: a contact sheet and a film, colour above depth."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import imageio.v2 as imageio
import matplotlib
import numpy as np
from numpy.typing import NDArray

from data_collection.dataset import RGBDDataset
from data_collection.video import write_video
from envs.files import written_aside

SHEET_FRAMES = 10
TILE = 128  # pixels: least edge of a frame in a picture
GAP = 4  # pixels between the tiles


def colour_depth(raw: NDArray[np.uint16], low: float, high: float) -> NDArray[np.uint8]:
    """Stored depth (..., H, W) -> colours (..., H, W, 3): red at `low` or nearer, blue at `high`, in stored units."""
    unit = np.clip((raw.astype(np.float32) - low) / max(1.0, high - low), 0.0, 1.0)
    return matplotlib.colormaps["turbo"](((1.0 - unit) * 255).astype(np.uint8), bytes=True)[..., :3]


def write_contact_sheet(dataset: RGBDDataset, episodes: Sequence[int], path: Path) -> None:
    """A PNG with two lines an episode: frames evenly spread over it, and their depth."""
    lines = []
    for frames in (_frames(dataset, number) for number in episodes):
        chosen = np.linspace(0, len(frames) - 1, min(SHEET_FRAMES, len(frames))).round().astype(int)
        tiles = [_tile(frames[i]) for i in chosen]
        tiles += [np.full_like(tiles[0], 255)] * (SHEET_FRAMES - len(tiles))  # a short episode
        lines.append(np.concatenate(tiles, axis=1))
    with written_aside(path) as aside:
        imageio.imwrite(aside, np.concatenate(lines), format="png")


def write_film(dataset: RGBDDataset, episodes: Sequence[int], path: Path) -> None:
    """An MP4 at the control rate of several episodes beside and below each other; a short one waits on its last frame.

    Raises:
        UsageError: see `write_video`; fewer episodes make a smaller film.
    """
    films = [_frames(dataset, number) for number in episodes]
    steps = max(len(frames) for frames in films)
    pictures = (_grid([_tile(frames[min(step, len(frames) - 1)]) for frames in films]) for step in range(steps))
    write_video(path, pictures, float(dataset.attrs["control_rate"]))


def _grid(tiles: Sequence[NDArray[np.uint8]]) -> NDArray[np.uint8]:
    """Tiles of one size in rows, of about a square in all; what is left of the last row is white."""
    height, width = tiles[0].shape[:2]
    columns = min(len(tiles), math.ceil(math.sqrt(len(tiles) * height / width)))
    full = [*tiles, *[np.full_like(tiles[0], 255)] * (-len(tiles) % columns)]
    rows = [np.concatenate(full[start : start + columns], axis=1) for start in range(0, len(full), columns)]
    return np.concatenate(rows)


def _frames(dataset: RGBDDataset, number: int) -> NDArray[np.uint8]:
    """(T, 2 * h, w, 3): an episode's colour above its depth."""
    columns: dict[str, Any] = dataset.episode(number)
    low, high = np.percentile(columns["depth"], (0.5, 99.5))
    return np.concatenate([columns["rgb"], colour_depth(columns["depth"], low, high)], axis=1)


def _tile(frame: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """A frame enlarged to at least `TILE` by a whole factor, with its share of the gap, its edges even numbers (video
    encoders want them)."""
    factor = max(1, -(-TILE // frame.shape[1]))
    large = frame.repeat(factor, axis=0).repeat(factor, axis=1)
    odd_height, odd_width = large.shape[0] % 2, large.shape[1] % 2
    return np.pad(large, ((0, GAP + odd_height), (0, GAP + odd_width), (0, 0)), constant_values=255)
