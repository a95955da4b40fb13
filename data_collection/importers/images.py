"""Pictures of any size to the size of the dataset: colour averaged, depth sampled, and the camera with them."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from envs.camera import CameraModel
from envs.errors import UsageError


def average_colour(rgb: NDArray[np.uint8], height: int, width: int) -> NDArray[np.uint8]:
    """Resize a colour picture: each new pixel is the mean over its area.

    Args:
        rgb: (H, W, 3) uint8.
        height: rows to be.
        width: pixels of a row to be.

    Returns:
        (height, width, 3) uint8.
    """
    if rgb.shape[:2] == (height, width):
        return rgb
    return np.asarray(Image.fromarray(rgb).resize((width, height), Image.Resampling.BOX))


def nearest_depth(depth: NDArray[Any], height: int, width: int) -> NDArray[Any]:
    """Resize a depth picture: each new pixel is the one under its centre, never a mean of two surfaces.

    Args:
        depth: (H, W) of any dtype and unit.
        height: rows to be.
        width: pixels of a row to be.

    Returns:
        (height, width), dtype of `depth`.
    """
    if depth.shape == (height, width):
        return depth
    rows = ((np.arange(height) + 0.5) * depth.shape[0] / height).astype(np.int64)
    columns = ((np.arange(width) + 0.5) * depth.shape[1] / width).astype(np.int64)
    return depth[np.ix_(rows, columns)]


def resize_camera(camera: CameraModel, height: int, width: int) -> CameraModel:
    """The camera of the resized pictures. Pixel centres are integers, so `cx' = (cx + 0.5) s - 0.5`.

    Raises:
        UsageError: the pictures to be are larger than those that are there.
    """
    if height > camera.height or width > camera.width:
        raise UsageError(
            f"--image-size {height} is more than the {camera.height}x{camera.width} of the pictures; give at most "
            f"{min(camera.height, camera.width)}"
        )
    K = camera.K.copy()
    for axis, scale in ((0, width / camera.width), (1, height / camera.height)):
        K[axis, axis] *= scale
        K[axis, 2] = (K[axis, 2] + 0.5) * scale - 0.5
    return CameraModel(width, height, K, camera.world_T_camera, camera.near, camera.far)
