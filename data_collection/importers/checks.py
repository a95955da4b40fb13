"""What is checked in what was read. A check raises `Damaged`, or returns a note if one can live with what it found."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from data_collection.importers.source import Damaged
from envs.camera import CameraModel

SAMPLED_SIDE = 32
"""About so many rows and columns of a depth picture are looked at."""
TOLERANCE = 0.1
"""The median depth of a frame may lie outside of the depth range by this share."""
NAMED_WITHIN = 1.2
"""A wrong unit is named if it explains the median depth up to this factor."""
DOUBTFUL_WITHIN = 1.15
"""A median depth inside the range is noted if a wrong unit explains it up to this factor."""
MOST_OUTSIDE = 0.5
"""More pixels than this outside of the depth range are noted."""
MOST_HOLES = 0.01
"""More pixels than this without depth are noted."""


def check_array(values: NDArray[Any], name: str, kind: str, shape: Sequence[int]) -> None:
    """Check dtype and shape, and that there is no NaN or infinity.

    Args:
        values: what was read.
        name: what to call it.
        kind: "uint8", "uint16", or "float" for any floating point.
        shape: what it must have.

    Raises:
        Damaged: it is something else.
    """
    fits = values.dtype.kind == "f" if kind == "float" else values.dtype == np.dtype(kind)
    if not fits or values.shape != tuple(shape):
        raise Damaged(f"{name} is {values.dtype} {values.shape}, not {kind} {tuple(shape)}")
    if values.dtype.kind == "f" and not np.isfinite(values).all():
        raise Damaged(f"{name} has values that are not finite")


class DepthCheck:
    """Looks at the depth pictures of a part, one after the other, and says at the end whether they can be metres.

    Args:
        camera: of the dataset to be, for its depth range.
        expected: how far away the middle of the scene is, metres.
        misreadings: what can have gone wrong -> by which factor depth is then off.
        scale: the `--depth-scale` that the pictures were read with.
        ceiling: depth from which on a pixel saw nothing, metres.
    """

    def __init__(
        self,
        camera: CameraModel,
        expected: float,
        misreadings: Mapping[str, float],
        scale: float = 1.0,
        ceiling: float = math.inf,
    ) -> None:
        self._camera, self._expected, self._misreadings = camera, expected, misreadings
        self._scale, self._ceiling = scale, ceiling
        self._medians: list[float] = []
        self._outside: list[float] = []
        self._holes: list[float] = []
        self._greatest = 0.0

    def look(self, metres: NDArray[Any]) -> None:
        """Take the next frame's depth into account, (H, W).

        Raises:
            Damaged: no pixel of it has a depth.
        """
        step = max(1, min(metres.shape) // SAMPLED_SIDE)
        sample = np.asarray(metres[::step, ::step], np.float32)
        valid = sample[(sample > 0) & (sample < self._ceiling)]
        if valid.size == 0:
            end = "; all that it holds is at the end of its scale: doubled?" if (sample > 0).any() else ""
            raise Damaged(f"no pixel of frame {len(self._medians)} has a depth{end}")
        self._medians.append(float(np.median(valid)))
        self._greatest = max(self._greatest, float(valid.max()))
        near, far = self._camera.near, self._camera.far
        self._outside.append(float(((sample < near) | (sample > far)).mean()))
        self._holes.append(float((sample <= 0).mean()))

    def notes(self) -> list[str]:
        """What is odd about the depth that was seen.

        Raises:
            Damaged: in some frame it is no depth in metres.
        """
        near, far = self._camera.near, self._camera.far
        frame = int(np.argmax(np.abs(np.log(np.array(self._medians) / self._expected))))
        median = self._medians[frame]
        if 0.9 < median <= 1.0 and self._greatest <= 1.0 and near > 1.1:
            raise Damaged(f"depth looks like a raw z-buffer (median {median:.4f}, none over 1), not like metres")
        error, name, factor = self._best_misreading(median)
        expected = f"where about {self._expected:.2f} m is expected"
        if not near * (1 - TOLERANCE) <= median <= far * (1 + TOLERANCE):
            what = f"median depth {median:.4g} m in frame {frame} {expected}"
            if error <= math.log(NAMED_WITHIN):
                raise Damaged(f"depth is {name}: {what}; read it with --depth-scale {self._scale / factor:.6g}")
            raise Damaged(f"{what}, not within {near:g} to {far:g} m; give --depth-scale, or --near and --far")
        notes = []
        if error <= math.log(DOUBTFUL_WITHIN) and abs(math.log(median / self._expected)) > error:
            notes.append(f"depth may be {name}: median {median:.3g} m in frame {frame} {expected}")
        outside, holes = float(np.mean(self._outside)), float(np.mean(self._holes))
        if outside > MOST_OUTSIDE:
            notes.append(f"{outside:.0%} of the depth lies outside of {near:g} to {far:g} m and is clipped")
        if holes > MOST_HOLES:
            notes.append(f"{holes:.0%} of the depth is missing (0) and reads as {near:g} m")
        return notes

    def _best_misreading(self, median: float) -> tuple[float, str, float]:
        """(how badly it explains the median: a log-ratio, what it is, its factor)."""
        return min(
            (abs(math.log(median / (self._expected * factor))), name, factor)
            for name, factor in self._misreadings.items()
        )


def odd_gripper(values: NDArray[Any], name: str) -> str | None:
    """What is to be said if gripper commands, of any shape, are not all signs."""
    wrong = values[np.abs(values) != 1]
    if not wrong.size:
        return None
    return f"{name} has the gripper at {wrong.flat[0]:.4g} ({wrong.size} of {values.size}), not at -1 or 1"


def note_unit_of_motion(motion: NDArray[Any], actions: NDArray[Any], unit: float) -> list[str]:
    """Note if the arm moves much more or less than its relative actions say.

    Args:
        motion: (T, 3) how far the end-effector went in each step, metres.
        actions: (T, 3) the actions.
        unit: metres that one unit of action is said to be.
    """
    sums = float((actions * actions).sum()), float((motion * motion).sum())
    if min(sums) <= 0 or np.abs(motion).sum() < 0.02:
        return []
    together = float((motion * actions).sum())
    correlation, metres = together / math.sqrt(sums[0] * sums[1]), together / sums[0]
    if correlation > 0.5 and not unit / 4 < metres < unit * 4:
        return [f"a unit of action moves the arm by {metres:.3g} m, not by {unit:g} m: actions in another unit?"]
    return []
