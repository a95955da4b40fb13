"""What a planned sequence costs, and how actions of the search become actions of the environment."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray
from torch import Tensor

ArrayOrTensor = TypeVar("ArrayOrTensor", NDArray[np.float64], Tensor)


def discounted_distance(distances: NDArray, discount: float = 0.95) -> NDArray[np.float64]:
    """Discounted sum of distances to the goal along trajectories: metres for a 3D model, pixels for a 2D one.

    Args:
        distances: (N, horizon), distance after each planned action.
        discount: weight of a step against the one before.

    Returns:
        costs: (N,), in the unit of the distances.
    """
    return np.asarray(distances, np.float64) @ discount ** np.arange(distances.shape[-1])


def env_action(move: NDArray, gripper: float) -> NDArray[np.float32]:
    """A translation as an action of the arm: no rotation, gripper held.

    Args:
        move: (..., 3), x, y, z in [-1, 1].
        gripper: the gripper's command, -1 or 1, kept as it is.

    Returns:
        actions: (..., 7) float32: the translation comes first, the gripper last.
    """
    action = np.zeros((*np.shape(move)[:-1], 7), np.float32)
    action[..., :3] = move
    action[..., -1] = gripper
    return action


@dataclass(frozen=True)
class Reach:
    """Draws the end-effector to where it can push the point towards its goal: beyond the point, as seen from there.

    What is not touched does not move, whatever is done elsewhere: without this, all plans that do not come to touch the
    thing in time would cost the same. At the goal there is nothing left to push, so it fades: the place is then the
    point itself, on the thing, where the end-effector cannot be and would push the thing on.
    """

    weight: float
    """of that distance beside the point's to its goal, far from there"""
    beyond: float
    """metres behind the point, far from the goal"""
    fade: float = 0.02
    """metres from the goal at which both are but half as much; at the goal they are 0"""

    def cost(
        self, effector: ArrayOrTensor, point: ArrayOrTensor, goal: ArrayOrTensor, per_metre: float = 1.0
    ) -> ArrayOrTensor:
        """Weighted distances (...) of end-effectors (..., D) for points (..., D) on their way to a goal (D,).

        Args:
            per_metre: what a metre is in the unit of the places: 1, or pixels for places in the picture.
        """
        way = point - goal
        length, fade = (way**2).sum(-1) ** 0.5, self.fade * per_metre
        place = point + self.beyond * per_metre * way / (length + fade)[..., None]
        return self.weight * length / (length + fade) * ((effector - place) ** 2).sum(-1) ** 0.5
