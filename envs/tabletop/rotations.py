"""Unit quaternions, wxyz as MuJoCo has them, over any leading dimensions."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


def multiply(left: Array, right: Array) -> Array:
    """The product (..., 4): first `right`, then `left`, both about the fixed axes."""
    w1, x1, y1, z1 = np.moveaxis(left, -1, 0)
    w2, x2, y2, z2 = np.moveaxis(right, -1, 0)
    return np.stack(
        [
            w1 * w2 - x1 * x2 - y1 * y2 - z1 * z2,
            w1 * x2 + x1 * w2 + y1 * z2 - z1 * y2,
            w1 * y2 - x1 * z2 + y1 * w2 + z1 * x2,
            w1 * z2 + x1 * y2 - y1 * x2 + z1 * w2,
        ],
        axis=-1,
    )


def conjugate(quat: Array) -> Array:
    """The inverse rotation (..., 4)."""
    return quat * np.array([1.0, -1.0, -1.0, -1.0])


def rotate(quat: Array, vector: Array) -> Array:
    """The vectors (..., 3) turned by `quat` (..., 4)."""
    w, axis = quat[..., :1], quat[..., 1:]
    twice = 2 * np.cross(axis, vector)
    return vector + w * twice + np.cross(axis, twice)


def from_rotvec(rotvec: Array) -> Array:
    """Quaternion (..., 4) of a rotation vector (..., 3), axis times angle in radians."""
    half = np.linalg.norm(rotvec, axis=-1, keepdims=True) / 2
    return np.concatenate([np.cos(half), np.sinc(half / np.pi) * rotvec / 2], axis=-1)


def to_rotvec(quat: Array) -> Array:
    """Rotation vector (..., 3) of the shorter way round, radians."""
    quat = np.where(quat[..., :1] < 0, -quat, quat)
    sine = np.linalg.norm(quat[..., 1:], axis=-1, keepdims=True)
    angle = 2 * np.arctan2(sine, quat[..., :1])
    return quat[..., 1:] * np.where(sine > 1e-12, angle / np.maximum(sine, 1e-12), 2.0)


def from_euler(euler: Array) -> Array:
    """Quaternion (..., 4) of turns about the fixed x, then y, then z axis (..., 3), radians."""
    turns = [from_rotvec(euler[..., i : i + 1] * np.eye(3)[i]) for i in range(3)]
    return multiply(turns[2], multiply(turns[1], turns[0]))


def to_euler(quat: Array) -> Array:
    """Angles (..., 3) in radians of turns about the fixed x, then y, then z axis that make up `quat`."""
    w, x, y, z = np.moveaxis(quat, -1, 0)
    roll = np.arctan2(2 * (w * x + y * z), 1 - 2 * (x * x + y * y))
    pitch = np.arcsin(np.clip(2 * (w * y - z * x), -1, 1))
    yaw = np.arctan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z))
    return np.stack([roll, pitch, yaw], axis=-1)
