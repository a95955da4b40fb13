"""DexHand as T3VIP published it: a Shadow Hand turning a cube in simulation, 25 frames an episode.

<episode>/rgbsub0.png, depthsub0.png (65535 = 10 m), joints0.txt: 24 joint angles in radians
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from data_collection.importers.png_folders import PngFolders, open_folders
from data_collection.importers.source import Damaged, SourceOptions

JOINTS = 24
FRAMES = 25


@dataclass(frozen=True, eq=False)
class DexHandSource(PngFolders):
    """An action is how far each joint went (radians), as the layout tells no commands: sums over a frame gap."""

    format = "dexhand"
    env_id = "dexhand"
    control_rate = 25.0
    action_aggregation = ("sum",) * JOINTS
    action_scale = (1.0,) * JOINTS
    png_far = 10.0
    range_m = (0.8264, 1.3312)
    expected_m = 1.08
    series = ("rgbsub", "depthsub", "joints")

    def robot(
        self, folder: Path, files: dict[str, list[Path]], count: int
    ) -> tuple[NDArray[np.float64], NDArray[np.float64], list[str]]:
        joints = np.stack([_read_joints(path) for path in files["joints"]])  # (T, 24)
        notes = [] if count == FRAMES else [f"{count} frames, not {FRAMES}"]
        largest = float(np.abs(joints).max())
        if largest > 2 * np.pi:
            notes.append(f"joint angles up to {largest:.4g}: degrees in place of radians?")
        return np.diff(joints, axis=0), joints, notes


def _read_joints(path: Path) -> NDArray[np.float64]:
    try:
        joints = np.array(path.read_text().replace(",", " ").split(), np.float64)
    except (OSError, ValueError) as error:
        raise Damaged(f"{path.name} is no list of numbers ({error})") from error
    if joints.shape != (JOINTS,):
        raise Damaged(f"{path.name} has {len(joints)} numbers, not {JOINTS}")
    if not np.isfinite(joints).all():
        raise Damaged(f"{path.name} has values that are not finite")
    return joints


def open_dexhand(options: SourceOptions) -> PngFolders:
    """Open a DexHand dataset, or one split of it.

    Raises:
        UsageError: there is none, or its camera is not told.
    """
    return open_folders(options, DexHandSource)
