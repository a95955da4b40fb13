"""Unit quaternions, wxyz as MuJoCo has them, over any leading dimensions."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


def multiply(left: Array, right: Array) -> Array:
    """The product (..., 4): first `right`, then `left`, both about the fixed axes."""
    w, x, y, z = (left[..., i] for i in range(4))
    a, b, c, d = (right[..., i] for i in range(4))
    product = np.empty(np.broadcast_shapes(left.shape, right.shape))
    product[..., 0] = w * a - x * b - y * c - z * d
    product[..., 1] = w * b + x * a + y * d - z * c
    product[..., 2] = w * c - x * d + y * a + z * b
    product[..., 3] = w * d + x * c - y * b + z * a
    return product


def conjugate(quat: Array) -> Array:
    """The inverse rotation (..., 4)."""
    return quat * np.array([1.0, -1.0, -1.0, -1.0])


def rotate(quat: Array, vector: Array) -> Array:
    """The vectors (..., 3) turned by `quat` (..., 4)."""
    w, axis = quat[..., :1], quat[..., 1:]
    twice = 2 * _cross(axis, vector)
    return vector + w * twice + _cross(axis, twice)


def from_rotvec(rotvec: Array) -> Array:
    """Quaternion (..., 4) of a rotation vector (..., 3), axis times angle in radians."""
    half = _norm(rotvec) / 2
    return np.concatenate([np.cos(half), np.sinc(half / np.pi) * rotvec / 2], axis=-1)


def to_rotvec(quat: Array) -> Array:
    """Rotation vector (..., 3) of the shorter way round, radians."""
    quat = np.where(quat[..., :1] < 0, -quat, quat)
    sine = _norm(quat[..., 1:])
    angle = 2 * np.arctan2(sine, quat[..., :1])
    return quat[..., 1:] * np.where(sine > 1e-12, angle / np.maximum(sine, 1e-12), 2.0)


def from_euler(euler: Array) -> Array:
    """Quaternion (..., 4) of turns about the fixed x, then y, then z axis (..., 3), radians."""
    (a, b, c), (d, e, f) = (np.moveaxis(half(euler / 2), -1, 0) for half in (np.cos, np.sin))
    quat = np.empty((*euler.shape[:-1], 4))
    quat[..., 0] = a * b * c + d * e * f
    quat[..., 1] = d * b * c - a * e * f
    quat[..., 2] = a * e * c + d * b * f
    quat[..., 3] = a * b * f - d * e * c
    return quat


def to_euler(quat: Array) -> Array:
    """Angles (..., 3) in radians of turns about the fixed x, then y, then z axis that make up `quat`."""
    w, x, y, z = (quat[..., i] for i in range(4))
    euler = np.empty((*quat.shape[:-1], 3))
    euler[..., 0] = np.arctan2(2 * (w * x + y * z), 1 - 2 * (x * x + y * y))
    euler[..., 1] = np.arcsin(np.clip(2 * (w * y - z * x), -1, 1))
    euler[..., 2] = np.arctan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z))
    return euler


def _cross(left: Array, right: Array) -> Array:
    """`np.cross` of (..., 3), to the same bits in a fraction of its time."""
    x, y, z = (left[..., i] for i in range(3))
    a, b, c = (right[..., i] for i in range(3))
    product = np.empty(np.broadcast_shapes(left.shape, right.shape))
    product[..., 0] = y * c - z * b
    product[..., 1] = z * a - x * c
    product[..., 2] = x * b - y * a
    return product


def _norm(vector: Array) -> Array:
    return np.sqrt((vector * vector).sum(axis=-1, keepdims=True))
