"""What controllers observe, and how those that show it to a world model take it in."""

from __future__ import annotations

from typing import Any

import numpy as np

from envs.camera import CameraModel
from envs.depth import clipped_depth
from envs.errors import UsageError

Observation = dict[str, Any]
"""`rgb` (H, W, 3) uint8, `depth` (H, W) metres, and `proprio`, which the effector reads. Others are left alone."""


def taken_in(observation: Observation, camera: CameraModel) -> Observation:
    """An observation as a world model may be shown it: checked, its depth clipped to the camera's range, and copied.

    A model predicts whatever it is shown, and of something else than it learned from it predicts nonsense. Copied,
    because a camera's driver may put the next frame where this one is.

    Raises:
        UsageError: something is missing, of another size or dtype, has NaN, or is not in metres.
    """
    missing = [name for name in ("rgb", "depth", "proprio") if name not in observation]
    if missing:
        raise UsageError(
            f"the observation has no '{missing[0]}', only {', '.join(observation)}; give rgb, depth, proprio"
        )
    rgb, depth, proprio = (np.array(observation[name]) for name in ("rgb", "depth", "proprio"))
    if rgb.dtype != np.uint8:
        raise UsageError(f"observation['rgb'] is {rgb.dtype}; give uint8 colours of 0 to 255")
    for name, given, shape in (
        ("rgb", rgb, (camera.height, camera.width, 3)),
        ("depth", depth, (camera.height, camera.width)),
    ):
        if given.shape != shape:
            raise UsageError(
                f"observation['{name}'] has shape {given.shape}; give {shape}, the size of the model's frames"
            )
    if not np.isfinite(proprio).all():
        raise UsageError(f"observation['proprio'] is {proprio.tolist()}; give finite numbers")
    clipped = clipped_depth(depth, camera.near, camera.far).astype(np.float32)
    return {**observation, "rgb": rgb, "depth": clipped, "proprio": proprio}
