"""What a planned sequence costs, and how actions of the search become actions of the environment."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray


def discounted_distance(distances: NDArray, discount: float = 0.95) -> NDArray[np.float64]:
    """Discounted sum of distances to the goal along trajectories: metres for a 3D model, pixels for a 2D one.

    Args:
        distances: (N, horizon), distance after each planned action.
        discount: weight of a step against the one before.

    Returns:
        costs: (N,), in the unit of the distances.
    """
    return np.asarray(distances, np.float64) @ discount ** np.arange(distances.shape[-1])


def env_action(move: NDArray, gripper: float, dim: int = 7) -> NDArray[np.float32]:
    """A translation as an action of the arm: no rotation, gripper held.

    Args:
        move: (..., 3), x, y, z in [-1, 1].
        gripper: the gripper's command, -1 or 1, kept as it is.
        dim: numbers in an action; the translation comes first, the gripper last.

    Returns:
        actions: (..., dim) float32.
    """
    action = np.zeros((*np.shape(move)[:-1], dim), np.float32)
    action[..., :3] = move
    action[..., -1] = gripper
    return action
