"""Depth as the cameras here have it: metres, without holes, within the camera's range."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from envs.errors import UsageError

FAR_OFF = 100.0
"""Times the range's far end: where most of a picture is farther than that, its unit is another, as millimetres."""


def clipped_depth(metres: NDArray[Any], near: float, far: float) -> NDArray[np.float64]:
    """Depth of any shape, clipped to [near, far], which infinity is beyond: float64.

    Raises:
        UsageError: near is not below far; depth is made of whole numbers, as sensors count millimetres, or has NaN, or
            most of it is far beyond the range.
    """
    if not 0 < near < far:
        raise UsageError(f"depth range is near={near!r}, far={far!r}; give metres with 0 < near < far")
    given = np.asarray(metres)
    if given.dtype.kind != "f":
        raise UsageError(f"depth is {given.dtype}; give metres as floats (of millimetres: depth * 0.001)")
    holes = np.count_nonzero(np.isnan(given))
    if holes:
        raise UsageError(
            f"depth has NaN in {holes} of {given.size} pixels; fill such holes first, as with what is around them"
        )
    beyond = given[np.isfinite(given) & (given > FAR_OFF * far)]
    if 2 * beyond.size > given.size:
        raise UsageError(
            f"most of the depth is about {np.median(beyond):.4g}, but the camera's range ends at {far:g} m; give metres"
        )
    return np.clip(given.astype(np.float64), near, far)
