"""Actions: increments of the place that the tip is moved to, and the heading of the push.

Everything works over leading dimensions, so that one environment and a batch of imagined ones move by the same code.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from envs.actions import clip_action
from envs.planar_push.scene import CONTROL_RATE

ACTION_SCALE = (0.025, 0.025, float(np.pi))  # m, m, rad
ACTION_AGGREGATION = ("sum", "sum", "last")
WORKSPACE_LOW, WORKSPACE_HIGH = np.array([-0.24, -0.24]), np.array([0.24, 0.24])  # m, of the tip

Array = NDArray[np.float64]


def check_action(action: ArrayLike) -> Array:
    """The action as (3,) float64 clipped to [-1, 1].

    Raises:
        UsageError: it does not have 3 finite numbers.
    """
    return clip_action(action, 3, "dx, dy, heading")


def advance(target: Array, actions: Array, noise: ArrayLike = 0.0) -> Array:
    """Where the tip goes, (..., 2) metres, from `target` (..., 2) by actions (..., 3); stays in the workspace."""
    return np.clip(target + actions[..., :2] * np.array(ACTION_SCALE[:2]) + noise, WORKSPACE_LOW, WORKSPACE_HIGH)


def motor_commands(start: Array, end: Array) -> Array:
    """Controls (..., 4) that take the tip from `start` to `end`, (..., 2) metres, in one control step.

    The velocity goes to the springs, whose rest moves with it, and to the dampers, which damp what differs from it.
    """
    velocity = (end - start) * CONTROL_RATE
    return np.concatenate([velocity, velocity], axis=-1)


def from_absolute(tip: ArrayLike, heading: ArrayLike) -> Array:
    """Omnipush's actions, absolute, as this environment's, relative.

    Args:
        tip: (T + 1, 2) position of the tip in each frame, metres.
        heading: (T,) of the push, radians.

    Returns:
        (T, 3); action t leads from frame t to frame t + 1. Outside of [-1, 1] where the tip is faster than here.
    """
    moves = np.diff(np.asarray(tip, np.float64), axis=0) / np.array(ACTION_SCALE[:2])
    turned = (np.asarray(heading, np.float64) + np.pi) % (2 * np.pi) - np.pi
    return np.column_stack([moves, turned / ACTION_SCALE[2]])


def to_absolute(start: ArrayLike, actions: ArrayLike) -> tuple[Array, Array]:
    """The inverse of `from_absolute`: tip (T + 1, 2), metres, and heading (T,), radians.

    Args:
        start: (2,) position of the tip in the first frame, metres.
        actions: (T, 3).
    """
    actions = np.asarray(actions, np.float64)
    moves = np.concatenate([np.zeros((1, 2)), actions[:, :2] * np.array(ACTION_SCALE[:2])])
    return np.asarray(start, np.float64) + np.cumsum(moves, axis=0), actions[:, 2] * ACTION_SCALE[2]
