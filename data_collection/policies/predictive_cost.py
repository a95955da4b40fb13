"""What the predictive policy wants: the cube turned as the goal asks, in the hand, and the hand ready to go on."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from envs.dexhand.goals import HOME, distances, is_dropped
from envs.dexhand.simulate import Paths
from envs.errors import UsageError

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Weights:
    """Costs of a moment, in radians of rotation that is left to do."""

    place: float = 30.0
    """Of a metre that the cube is from where it lies in the hand, beyond `free`."""
    free: float = 0.02
    """m."""
    low: float = 60.0
    """Of a metre that the cube is lower than `height`."""
    height: float = 0.145
    """m, of the cube in the hand."""
    drop: float = 20.0
    """Of a cube that is out of the hand."""
    posture: float = 0.3
    """Of all joints at the ends of their ranges: a hand that is wide open or clenched has nowhere to go."""

    def __post_init__(self) -> None:
        for name, value in vars(self).items():
            if not value >= 0:
                raise UsageError(f"weight {name} is {value}; give a number that is not negative")


def step_costs(weights: Weights, paths: Paths, actions: Array, goal: Array) -> Array:
    """The cost (N, T) of each step of N plans; infinite where the simulation broke down.

    Args:
        weights: of the terms.
        paths: of the plans.
        actions: (N, T, 20).
        goal: pose (7,) that the cube shall have.
    """
    _, rotation = distances(paths.cube_pose, goal)
    place = paths.cube_pose[..., :3]
    away = np.linalg.norm(place[..., :2] - HOME[:2], axis=-1)
    costs = (
        rotation
        + weights.place * np.maximum(away - weights.free, 0)
        + weights.low * np.maximum(weights.height - place[..., 2], 0)
        + weights.drop * is_dropped(paths.cube_pose)
        + weights.posture * np.square(actions).mean(-1)
    )
    return np.where(np.isfinite(costs), costs, np.inf)
