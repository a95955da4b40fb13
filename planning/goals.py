"""What a controller is asked for: a point, and where it shall be."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray


@dataclass(frozen=True, eq=False)
class Goal:
    """Where a designated point is to go.

    Attributes:
        point_world: (3,) float64, metres, world frame.
        pixel: (2,) float64, the same point in the picture (u, v), pixels.
        designated: (3,) float64, metres, world frame: where the point that is to go there is in the first frame, on a
            surface that the camera sees, as clicking a pixel of an RGB-D frame gives it. None for the end-effector's.
    """

    point_world: NDArray[np.float64]
    pixel: NDArray[np.float64]
    designated: NDArray[np.float64] | None = None
