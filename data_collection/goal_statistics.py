"""How far a dataset of the dexterous hand brings the cube to its goals."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from envs.dexhand.goals import distances, is_dropped, is_reached


def goal_statistics(scene_obs: NDArray[Any], slices: NDArray[np.int64]) -> dict[str, Any]:
    """Goals given and reached, rotation errors where a goal is given and where it ends, and cubes dropped.

    A goal ends where it is reached, where the cube is dropped, or with the episode.

    Args:
        scene_obs: (N, 14), the pose of the cube, then of its goal.
        slices: (E, 2) first row and row past the last of each episode.
    """
    starts, ends, steps, dropped = [], [], [], []
    for first, stop in slices:
        goals = scene_obs[first:stop, 7:]
        changes = first + 1 + np.flatnonzero((goals[1:] != goals[:-1]).any(axis=1))
        bounds = np.array([first, *changes, stop])
        starts += bounds[:-1].tolist()
        ends += (bounds[1:] - 1).tolist()
        steps += (bounds[1:] - 1 - bounds[:-1]).tolist()
        dropped.append(bool(is_dropped(scene_obs[stop - 1, :7])))
    cube, goal = scene_obs[:, :7], scene_obs[:, 7:]
    errors = np.degrees(distances(cube, goal)[1])
    reached = is_reached(cube[ends], goal[ends])
    return {
        "given": len(starts),
        "reached": round(float(reached.mean()), 4),
        "median_steps_to_reach": float(np.median(np.array(steps)[reached])) if reached.any() else None,
        "median_degrees_at_start": round(float(np.median(errors[starts])), 1),
        "median_degrees_at_end": round(float(np.median(errors[ends])), 1),
        "episodes_dropped": round(float(np.mean(dropped)), 4),
    }
