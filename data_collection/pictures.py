"""Pictures of a dataset: a contact sheet and a film, colour above depth."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import imageio.v2 as imageio
import imageio_ffmpeg
import matplotlib
import numpy as np
from numpy.typing import NDArray

from data_collection.dataset import RGBDDataset
from data_collection.files import written_aside

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
        tiles = [_padded(frames[i]) for i in chosen]
        tiles += [np.full_like(tiles[0], 255)] * (SHEET_FRAMES - len(tiles))  # a short episode
        lines.append(np.concatenate(tiles, axis=1))
    with written_aside(path) as aside:
        imageio.imwrite(aside, np.concatenate(lines), format="png")


def write_film(dataset: RGBDDataset, episodes: Sequence[int], path: Path) -> None:
    """An MP4 at the control rate of several episodes side by side; a short one waits on its last frame."""
    films = [_frames(dataset, number) for number in episodes]
    with written_aside(path) as aside:
        film: Any = None
        for step in range(max(len(frames) for frames in films)):
            tiles = [_padded(frames[min(step, len(frames) - 1)]) for frames in films]
            picture = np.concatenate(tiles, axis=1)
            if film is None:
                film = imageio_ffmpeg.write_frames(
                    str(aside),
                    picture.shape[1::-1],
                    fps=float(dataset.attrs["control_rate"]),
                    macro_block_size=2,
                    output_params=["-f", "mp4"],  # the temporary name does not say so
                )
                film.send(None)
            film.send(np.ascontiguousarray(picture))
        film.close()


def _frames(dataset: RGBDDataset, number: int) -> NDArray[np.uint8]:
    """(T, 2 * h, w, 3): an episode's colour above its depth, enlarged to at least `TILE` by whole factors."""
    columns: dict[str, Any] = dataset.episode(number)
    low, high = np.percentile(columns["depth"], (0.5, 99.5))
    frames = np.concatenate([columns["rgb"], colour_depth(columns["depth"], low, high)], axis=1)
    factor = max(1, -(-TILE // columns["rgb"].shape[2]))
    return frames.repeat(factor, axis=1).repeat(factor, axis=2)


def _padded(frame: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """A tile with its share of the gap, its edges even numbers (video encoders want them)."""
    odd_height, odd_width = frame.shape[0] % 2, frame.shape[1] % 2
    return np.pad(frame, ((0, GAP + odd_height), (0, GAP + odd_width), (0, 0)), constant_values=255)
