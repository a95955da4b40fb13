"""Omnipush (Bauza et al. 2019) as T3VIP published it, with depth: a robot pushes objects, 12 frames a push.

<object>/<push>/rgbsub0.png, depthsub0.png (65535 = 1.2 m), actions.npy (T, 3): x and y of the tip in metres, heading of
the push in radians
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from data_collection.importers.checks import check_array
from data_collection.importers.png_folders import PngFolders, open_folders
from data_collection.importers.source import Damaged, SourceOptions

ACTIONS = "actions.npy"
PUSH_FRAMES = 12
FARTHEST_M = 3.0
"""No tip is farther from the robot than this."""
PUBLISHED = {
    # The colour camera, 1280x720, of which the columns 280 to 1000 are kept.
    "K": np.array([[928.70, 0, 657.50 - 280], [0, 928.17, 356.48], [0, 0, 1]]),
    "size": np.array([720, 720]),
}


@dataclass(frozen=True, eq=False)
class OmnipushSource(PngFolders):
    """Row t of actions.npy is where the tip is in frame t. So action t, which leads to frame t+1, is row t+1: an
    absolute target, of which the last holds over a frame gap; row t itself is the proprioception."""

    format = "omnipush"
    env_id = "omnipush"
    control_rate = 12.0  # a push takes about a second
    action_aggregation = ("last", "last", "last")
    action_scale = (1.0, 1.0, 1.0)
    png_far = 1.2
    range_m = (0.35, 1.2)
    expected_m = 1.1
    series = ("rgbsub", "depthsub")

    def robot(
        self, folder: Path, files: dict[str, list[Path]], count: int
    ) -> tuple[NDArray[np.float64], NDArray[np.float64], list[str]]:
        try:
            tip = np.load(folder / ACTIONS, allow_pickle=False)
        except FileNotFoundError:
            raise Damaged(f"{ACTIONS} is missing") from None
        except Exception as error:  # what a flipped byte makes of a file has many names
            raise Damaged(f"{ACTIONS} does not unpack ({type(error).__name__})") from error
        check_array(tip, ACTIONS, "float", (count, 3))
        notes = [] if count % PUSH_FRAMES == 0 else [f"{count} frames, not a multiple of {PUSH_FRAMES}"]
        farthest = float(np.abs(tip[:, :2]).max())
        if farthest > FARTHEST_M:
            notes.append(f"tip up to {farthest:.4g} m away: millimetres in place of metres?")
        return tip[1:].astype(np.float64), tip.astype(np.float64), notes


def open_omnipush(options: SourceOptions) -> PngFolders:
    """Open an Omnipush dataset, or one split of it.

    Raises:
        UsageError: there is none.
    """
    return open_folders(options, OmnipushSource, PUBLISHED)
