"""One setup, two models, side by side in time: T3VIP arrives, a model of pictures ends before or behind the goal."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

import imageio.v3 as iio
import numpy as np
from numpy.typing import NDArray

from envs.files import written_aside
from planning.episode import Record
from planning.film import VIEWS, film_path

COLUMNS = 5
GAP = 6  # white pixels between the models


def filmstrip(videos: Path, filmed: Mapping[str, Sequence[Record]], path: Path) -> bool:
    """Draw an episode of each model from films, the robot's view above the second one, as a PNG.

    All columns show the same control steps, close together at first; an episode that ended earlier stays at its last.

    Args:
        videos: folder of the films.
        filmed: model -> its records, episode by episode the same setups for all; T3VIP first.
        path: of the picture.

    Returns:
        Whether there was a setup that all models were filmed in; without one nothing is drawn.
    """
    couples = [
        couple
        for couple in zip(*filmed.values(), strict=True)
        if all(film_path(videos, record).with_suffix(".mp4").exists() for record in couple)
    ]
    if not couples:
        return False
    chosen = max(couples, key=telling)
    films = [iio.imread(film_path(videos, record).with_suffix(".mp4")) for record in chosen]
    last = max(len(film) for film in films) - 1
    moments = np.rint(last * np.linspace(0, 1, COLUMNS) ** 1.7).astype(int)
    strips = []
    for film in films:
        strips.append(np.concatenate([_stacked(film[min(moment, len(film) - 1)]) for moment in moments], axis=1))
        strips.append(np.full((GAP, *strips[0].shape[1:]), 255, np.uint8))
    with written_aside(path) as aside:
        iio.imwrite(aside, np.concatenate(strips[:-1]), extension=".png")
    return True


def telling(couple: Sequence[Record]) -> tuple[bool, bool, float]:
    """How well an episode of T3VIP and one of a rival show the difference: the more the better.

    Best is where the rival reaches the pixel and misses the point, while T3VIP reaches it; then, the nearer it ends to
    the pixel and the farther from the point, as shares of the way.
    """
    ours, theirs = couple
    misses = theirs.reached("2d") and not theirs.reached("3d")
    beside = theirs.final_distance / theirs.initial_distance
    beside -= theirs.final_pixel_distance / theirs.initial_pixel_distance
    return misses and ours.reached("3d"), misses, beside


def _stacked(frame: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """The views of a film's frame, one above the other."""
    return np.concatenate(np.split(frame, len(VIEWS), axis=1), axis=0)
