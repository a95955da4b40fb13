"""Actions: where 20 actuators shall take their joints, as a share of the way from one end of their range to the other.

Targets are absolute, as in gymnasium-robotics: an action then means the same whatever came before it, so a model that
sees two frames misses nothing, and over a frame gap the last one holds. Increments would add up on a hidden target.
"""

from __future__ import annotations

import mujoco
import numpy as np
from numpy.typing import ArrayLike, NDArray

from envs.actions import clip_action

ACTUATORS, JOINTS = 20, 24  # the last two joints of each of four fingers are coupled by a tendon
ACTION_AGGREGATION = ("last",) * ACTUATORS


def check_action(action: ArrayLike) -> NDArray[np.float64]:
    """The action as (20,) float64 clipped to [-1, 1].

    Raises:
        UsageError: it does not have 20 finite numbers.
    """
    return clip_action(action, ACTUATORS, "one for each actuator")


def joint_targets(model: mujoco.MjModel, actions: NDArray[np.float64]) -> NDArray[np.float64]:
    """Actions (..., 20) in [-1, 1] as joint targets (..., 20), radians: -1 and 1 are the ends of the ranges."""
    low, high = model.actuator_ctrlrange.T
    return low + (actions + 1) / 2 * (high - low)


def action_scale(model: mujoco.MjModel) -> tuple[float, ...]:
    """What 1 stands for, rad, for each of 20 actuators: half of its range."""
    low, high = model.actuator_ctrlrange.T
    return tuple(float(half) for half in (high - low) / 2)


def actions_of(model: mujoco.MjModel, targets: NDArray[np.float64]) -> NDArray[np.float64]:
    """The inverse of `joint_targets`."""
    low, high = model.actuator_ctrlrange.T
    return 2 * (targets - low) / (high - low) - 1
