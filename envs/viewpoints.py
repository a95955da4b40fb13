"""Where cameras stand and how they are turned: as MuJoCo has it, x right, y up, looking along -z."""

from __future__ import annotations

import mujoco
import numpy as np
from numpy.typing import ArrayLike, NDArray

Array = NDArray[np.float64]


def look_at(eye: ArrayLike, target: ArrayLike, up: ArrayLike) -> Array:
    """Axes of a camera at `eye` that looks at `target`.

    Args:
        eye: (3,) metres.
        target: (3,) metres.
        up: (3,) which way is up in the picture, more or less; of any length, but not along the view.

    Returns:
        (3, 3): its columns point right, up and back, in the world.
    """
    back = np.subtract(eye, target)
    back /= np.linalg.norm(back)
    right = np.cross(np.asarray(up, np.float64), back)
    right /= np.linalg.norm(right)
    return np.column_stack([right, np.cross(back, right), back])


def orbit(target: ArrayLike, distance: float, elevation: float, azimuth: float) -> tuple[Array, Array]:
    """Place (3,) and axes (3, 3), as of `look_at`, of an upright camera that looks at `target` from around it.

    Args:
        target: (3,) metres.
        distance: from it, metres.
        elevation: above the horizontal, degrees; 90 is allowed.
        azimuth: about the vertical, from +x towards +y, degrees.
    """
    # Not by way of `look_at`, which rounds otherwise: datasets tell cameras apart by the last bit.
    elevation, azimuth = np.radians(elevation), np.radians(azimuth)
    back = np.array([np.cos(elevation) * np.cos(azimuth), np.cos(elevation) * np.sin(azimuth), np.sin(elevation)])
    right = np.array([-np.sin(azimuth), np.cos(azimuth), 0.0])
    return np.asarray(target) + distance * back, np.column_stack([right, np.cross(back, right), back])


def quaternion(axes: Array) -> Array:
    """The orientation (4,), unit quaternion wxyz, of axes (3, 3)."""
    quat = np.empty(4)
    mujoco.mju_mat2Quat(quat, axes.ravel())
    return quat
