"""CALVIN's relative actions: increments of a target pose that the hand follows.

Everything works over leading dimensions, so that one environment and a batch of imagined ones move by the same code.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from envs import rotations
from envs.actions import clip_action
from envs.tabletop.robot import FINGER_TRAVEL
from envs.tabletop.scene import CONTROL_RATE

ACTION_SCALE = (0.02, 0.02, 0.02, 0.05, 0.05, 0.05, 1.0)  # m, rad, sign
ACTION_AGGREGATION = ("sum", "sum", "sum", "rotate", "rotate", "rotate", "last")
SIGNS = (6,)  # the gripper
WORKSPACE_LOW, WORKSPACE_HIGH = np.array([-0.32, -0.46, 0.30]), np.array([0.34, 0.10, 0.78])  # m, see `advance`
MAX_LEAD, MAX_TURN_LEAD = 0.03, 0.10  # m, rad: how far the target may be from the measured pose

Array = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Pose:
    """Positions (..., 3) in metres and unit quaternions wxyz (..., 4), world frame."""

    position: Array
    quaternion: Array


def check_action(action: ArrayLike) -> Array:
    """The action as (7,) float64 clipped to [-1, 1].

    Raises:
        UsageError: it does not have 7 finite numbers.
    """
    return clip_action(action, 7, "dx dy dz, turns about x y z, gripper")


def advance(target: Pose, tcp: Pose, actions: Array) -> Pose:
    """The target pose after an action.

    Args:
        target: the target pose so far.
        tcp: the measured pose of the tool centre point.
        actions: (..., 7) in [-1, 1]; increments along and about the world's axes.

    Returns:
        The new target pose, at most MAX_LEAD and MAX_TURN_LEAD from the measured pose. Its position is clipped to the
        workspace before it is drawn to within MAX_LEAD: where the measured pose is outside, the target may be, too.
    """
    scaled = actions * np.array(ACTION_SCALE)
    position = np.clip(target.position + scaled[..., :3], WORKSPACE_LOW, WORKSPACE_HIGH)
    position = tcp.position + _shorten(position - tcp.position, MAX_LEAD)
    quaternion = rotations.multiply(rotations.from_euler(scaled[..., 3:6]), target.quaternion)
    lead = rotations.to_rotvec(rotations.multiply(quaternion, rotations.conjugate(tcp.quaternion)))
    short = rotations.multiply(rotations.from_rotvec(_shorten(lead, MAX_TURN_LEAD)), tcp.quaternion)
    too_far = np.linalg.norm(lead, axis=-1, keepdims=True) > MAX_TURN_LEAD
    return Pose(position, np.where(too_far, short, quaternion))


def velocity(start: Pose, end: Pose) -> Array:
    """The constant velocity (..., 6) that takes a free body from `start` to `end` in one control step.

    Linear in the world frame, m/s; angular in the body's frame, rad/s, as MuJoCo has it.
    """
    turn = rotations.to_rotvec(rotations.multiply(rotations.conjugate(start.quaternion), end.quaternion))
    return np.concatenate([end.position - start.position, turn], axis=-1) * CONTROL_RATE


def _shorten(vector: Array, longest: float) -> Array:
    length = np.linalg.norm(vector, axis=-1, keepdims=True)
    return vector * np.minimum(1.0, longest / np.maximum(length, 1e-12))


def finger_targets(commands: ArrayLike) -> Array:
    """Where each finger goes, (..., 2) metres, for gripper commands (...): open from 0 upwards, else closed."""
    opening = np.where(np.asarray(commands) >= 0, FINGER_TRAVEL, 0.0)
    return np.stack([opening, -opening], axis=-1)
