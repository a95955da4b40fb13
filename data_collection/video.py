"""Pictures as an MP4, encoded by ffmpeg. A film is whole, or the one of before stays."""

from __future__ import annotations

import contextlib
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import imageio_ffmpeg
import numpy as np
from numpy.typing import NDArray

from envs.errors import UsageError
from envs.files import written_aside


def write_video(path: Path, pictures: Iterable[NDArray[np.uint8]], fps: float, quality: float = 5) -> None:
    """Write pictures as an MP4.

    Args:
        path: a file; what is there is replaced when the film is whole.
        pictures: (H, W, 3) each, all of one size; each is encoded when it comes, so that a generator will do.
        fps: pictures a second.
        quality: of the encoder, 0 to 10; more is larger.

    Raises:
        UsageError: ffmpeg does not write it. It may just end, without an error, so its file is looked at.
    """
    with written_aside(path) as aside:
        size, count = _encode(pictures, fps, quality, aside)
        if not _is_film(aside, count):
            raise UsageError(
                f"ffmpeg does not write {path} ({size}, {count} pictures); make room for it, or ask for a smaller film"
            )


def _encode(pictures: Iterable[NDArray[np.uint8]], fps: float, quality: float, path: Path) -> tuple[str, int]:
    """Send pictures to ffmpeg; returns their size, in words, and how many there were."""
    encoder: Any = None
    size, count = "no size", 0
    for picture in pictures:
        if encoder is None:
            size = f"{picture.shape[1]} x {picture.shape[0]} pixels"
            encoder = imageio_ffmpeg.write_frames(
                str(path),
                picture.shape[1::-1],
                fps=fps,
                quality=quality,
                macro_block_size=2,
                ffmpeg_log_level="quiet",
                output_params=["-f", "mp4"],  # the temporary name does not say so
            )
            encoder.send(None)
        count += 1
        try:
            encoder.send(np.ascontiguousarray(picture))
        except OSError:  # ffmpeg has ended
            break
    if encoder is not None:
        with contextlib.suppress(OSError):
            encoder.close()
    return size, count


def _is_film(path: Path, count: int) -> bool:
    """Whether a file holds so many pictures."""
    try:
        return imageio_ffmpeg.count_frames_and_secs(str(path))[0] == count
    except (OSError, RuntimeError):
        return False
