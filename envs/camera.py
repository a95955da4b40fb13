"""A pinhole camera: intrinsics, pose, and the depth range that everybody downstream works in."""

from __future__ import annotations

import json
import math
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from envs.errors import UsageError


@dataclass(frozen=True, eq=False)
class CameraModel:
    """A pinhole camera in OpenCV's frame: +x right, +y down, +z forward, metres.

    Pixel centres are integers (row 0 is the top of the image), so the optical axis of a symmetric camera meets the
    image at `cx = (width - 1) / 2`, `cy = (height - 1) / 2`. Depth is planar: the z coordinate in the camera frame.
    """

    width: int
    """Pixels in a row."""
    height: int
    """Rows."""
    K: NDArray[np.float64]
    """Intrinsics (3, 3), in pixels."""
    world_T_camera: NDArray[np.float64]
    """Pose (4, 4): takes points of the camera frame to the world frame, metres."""
    near: float
    """Least depth of the working range, metres. Depth is clipped to it, quantised over it, scaled by it to [0, 1]."""
    far: float
    """Greatest depth of the working range, metres."""

    def __post_init__(self) -> None:
        for side in ("width", "height"):
            value = getattr(self, side)
            if not isinstance(value, (int, np.integer)) or isinstance(value, bool) or value < 1:
                raise UsageError(f"camera {side} is {value!r}; give a whole number of pixels, at least 1")
            object.__setattr__(self, side, int(value))
        near, far = float(self.near), float(self.far)
        if not (math.isfinite(near) and math.isfinite(far) and 0.0 < near < far):
            raise UsageError(f"depth range is near={self.near!r}, far={self.far!r}; give metres with 0 < near < far")
        object.__setattr__(self, "near", near)
        object.__setattr__(self, "far", far)
        K = _frozen_matrix("K", self.K, (3, 3))
        fixed_entries = K[[0, 1, 2, 2, 2], [1, 0, 0, 1, 2]]
        if K[0, 0] <= 0 or K[1, 1] <= 0 or not np.array_equal(fixed_entries, [0, 0, 0, 0, 1]):
            raise UsageError(f"K is {K.tolist()}; give [[fx, 0, cx], [0, fy, cy], [0, 0, 1]] with positive fx and fy")
        pose = _frozen_matrix("world_T_camera", self.world_T_camera, (4, 4))
        rotation = pose[:3, :3]
        rigid = np.allclose(rotation @ rotation.T, np.eye(3), atol=1e-5) and np.linalg.det(rotation) > 0
        if not rigid or not np.array_equal(pose[3], [0, 0, 0, 1]):
            raise UsageError(f"world_T_camera is {pose.tolist()}; give a rigid transform [[R, t], [0, 0, 0, 1]]")
        object.__setattr__(self, "K", K)
        object.__setattr__(self, "world_T_camera", pose)

    @classmethod
    def from_fovy(
        cls, width: int, height: int, fovy: float, world_T_camera: ArrayLike, near: float, far: float
    ) -> CameraModel:
        """A camera with square pixels and its axis through the middle of the image.

        Args:
            width: pixels in a row.
            height: rows.
            fovy: vertical field of view, degrees.
            world_T_camera: pose (4, 4).
            near: least depth of the working range, metres.
            far: greatest depth of the working range, metres.
        """
        if not 0.0 < fovy < 180.0:
            raise UsageError(f"vertical field of view is {fovy!r}; give degrees between 0 and 180")
        focal = (height / 2) / math.tan(math.radians(fovy) / 2)
        K = np.array([[focal, 0, (width - 1) / 2], [0, focal, (height - 1) / 2], [0, 0, 1]])
        return cls(width, height, K, np.asarray(world_T_camera, dtype=np.float64), near, far)

    def pixels(self) -> NDArray[np.float64]:
        """Coordinates (u, v) of every pixel centre: (height, width, 2)."""
        u, v = np.meshgrid(np.arange(self.width, dtype=np.float64), np.arange(self.height, dtype=np.float64))
        return np.stack([u, v], axis=-1)

    def unproject(self, depth: ArrayLike) -> NDArray[np.float64]:
        """The point that each pixel sees.

        Args:
            depth: (..., height, width) planar depth, metres.

        Returns:
            (..., height, width, 3) points in the camera frame, metres.

        Raises:
            UsageError: the depth image is not of the camera's size.
        """
        depth = np.asarray(depth, dtype=np.float64)
        if depth.shape[-2:] != (self.height, self.width):
            raise UsageError(
                f"depth has shape {depth.shape}; the last two dimensions must be the camera's (height, width)"
                f" = {(self.height, self.width)}"
            )
        rays = (self.pixels() - self.K[:2, 2]) / self.K[[0, 1], [0, 1]]  # (H, W, 2), at unit depth
        return np.concatenate([rays * depth[..., None], depth[..., None]], axis=-1)

    def project(self, points: ArrayLike) -> NDArray[np.float64]:
        """Where points appear in the image.

        Args:
            points: (..., 3) in the camera frame, metres.

        Returns:
            (..., 2) pixel coordinates (u, v). NaN for points that do not lie in front of the camera (z <= 0).
        """
        points = np.asarray(points, dtype=np.float64)
        z = points[..., 2:]
        z = np.where(z > 0, z, np.nan)
        return points[..., :2] / z * self.K[[0, 1], [0, 1]] + self.K[:2, 2]

    def to_world(self, points: ArrayLike) -> NDArray[np.float64]:
        """Points (..., 3) of the camera frame in the world frame, metres."""
        rotation, position = self.world_T_camera[:3, :3], self.world_T_camera[:3, 3]
        return np.asarray(points, dtype=np.float64) @ rotation.T + position

    def to_camera(self, points: ArrayLike) -> NDArray[np.float64]:
        """Points (..., 3) of the world frame in the camera frame, metres."""
        rotation, position = self.world_T_camera[:3, :3], self.world_T_camera[:3, 3]
        return (np.asarray(points, dtype=np.float64) - position) @ rotation

    def to_dict(self) -> dict[str, Any]:
        """The camera as numbers and lists that JSON can hold, exact to the last bit."""
        return {
            "width": self.width,
            "height": self.height,
            "K": self.K.tolist(),
            "world_T_camera": self.world_T_camera.tolist(),
            "near": self.near,
            "far": self.far,
        }

    @classmethod
    def from_dict(cls, fields: Any) -> CameraModel:
        """The camera that `to_dict` gave.

        Raises:
            UsageError: it is no dict of a camera's fields.
        """
        names = {"width", "height", "K", "world_T_camera", "near", "far"}
        if not isinstance(fields, dict) or set(fields) != names:
            found = sorted(fields) if isinstance(fields, dict) else type(fields).__name__
            raise UsageError(f"camera has {found}; it needs exactly {sorted(names)}, as to_dict and to_json give them")
        return cls(**fields)

    def to_json(self) -> str:
        """The camera as one line of JSON, exact to the last bit."""
        return json.dumps(self.to_dict())

    @classmethod
    def from_json(cls, text: str) -> CameraModel:
        """The camera that `to_json` wrote.

        Raises:
            UsageError: the text is no JSON object with a camera's fields.
        """
        try:
            fields = json.loads(text)
        except (TypeError, ValueError) as error:
            raise UsageError(f"camera {str(text)[:60]!r} is not JSON ({error}); give what to_json wrote") from error
        return cls.from_dict(fields)


def _frozen_matrix(name: str, value: ArrayLike, shape: tuple[int, int]) -> NDArray[np.float64]:
    """A read-only float64 copy, checked for shape and finiteness."""
    try:
        matrix = np.array(value, dtype=np.float64)
    except (TypeError, ValueError) as error:
        raise UsageError(f"camera {name} is {value!r}; give {shape} numbers") from error
    if matrix.shape != shape or not np.isfinite(matrix).all():
        raise UsageError(f"camera {name} is {matrix.tolist()}, of shape {matrix.shape}; give {shape} finite numbers")
    matrix.setflags(write=False)
    return matrix
