"""How far a dataset of the dexterous hand brings the cube to its goals."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from envs.dexhand.goals import distances, is_dropped, is_reached


def goal_statistics(scene_obs: NDArray[Any], slices: NDArray[np.int64]) -> dict[str, Any]:
    """Goals given and reached, rotation errors where a goal is given and where it ends, and cubes dropped.

    A goal ends where it is reached, where the cube is dropped, or with the episode. The row in which one is reached
    still has it, though the next one is given there: that one starts with the cube of this row.

    Args:
        scene_obs: (N, 14), the pose of the cube, then of its goal.
        slices: (E, 2) first row and row past the last of each episode.
    """
    cube, goal = scene_obs[:, :7], scene_obs[:, 7:]
    starts, ends, dropped = [], [], []
    for first, stop in slices:
        last_rows = first + np.flatnonzero((goal[first + 1 : stop] != goal[first : stop - 1]).any(axis=1))
        starts += [first, *last_rows]
        ends += [*last_rows, stop - 1]
        dropped.append(bool(is_dropped(cube[stop - 1])))
    steps = np.array(ends) - starts
    reached = is_reached(cube[ends], goal[ends])
    at_start, at_end = (np.degrees(distances(cube[rows], goal[ends])[1]) for rows in (starts, ends))
    return {
        "given": len(starts),
        "reached": round(float(reached.mean()), 4),
        "median_steps_to_reach": float(np.median(steps[reached])) if reached.any() else None,
        "median_degrees_at_start": round(float(np.median(at_start)), 1),
        "median_degrees_at_end": round(float(np.median(at_end)), 1),
        "episodes_dropped": round(float(np.mean(dropped)), 4),
    }
