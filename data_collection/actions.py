"""What several actions in a row amount to when the frames between them are skipped."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import scipy  # its parts load when they are used
from numpy.typing import NDArray

AGGREGATIONS = ("sum", "rotate", "last")


def aggregate_actions(
    actions: NDArray[Any], aggregation: Sequence[str], scale: Sequence[float] | NDArray[Any] | None = None
) -> NDArray[Any]:
    """The one action that does what `g` actions in a row do, in the same units (a sum may leave [-1, 1]).

    Args:
        actions: (..., g, A), in order of time.
        aggregation: for each of the A numbers how it adds up. "sum": it is an increment, e.g. of position. "rotate":
            it is one of three neighbours that are Euler angles xyz about the fixed world axes, an increment of
            orientation; increments compose as rotations, the first applied first. "last": it is an absolute target or
            a sign; the last one holds.
        scale: (A,) physical size of one unit, radians for "rotate"; needed only there.

    Returns:
        (..., A), dtype of `actions`.

    Raises:
        ValueError: the aggregation does not fit the actions.
    """
    groups = _rotation_groups(aggregation)
    if actions.ndim < 2 or actions.shape[-1] != len(aggregation):
        raise ValueError(f"actions of shape {actions.shape} do not end in (g, {len(aggregation)})")
    if actions.shape[-2] == 0:
        raise ValueError("no action to aggregate: g is 0")
    if actions.shape[-2] == 1:
        return actions[..., 0, :].copy()
    total = actions[..., -1, :].copy()
    summed = [i for i, kind in enumerate(aggregation) if kind == "sum"]
    total[..., summed] = actions[..., summed].sum(axis=-2)
    if groups and scale is None:
        raise ValueError("'rotate' needs the scale: radians per unit")
    for first in groups:
        unit = np.asarray(scale, np.float64)[first : first + 3]
        total[..., first : first + 3] = _compose(actions[..., first : first + 3] * unit) / unit
    return total


def _compose(euler: NDArray[Any]) -> NDArray[np.float64]:
    """(..., g, 3) increments in radians about world axes -> (..., 3) the whole turn."""
    steps = euler.reshape(-1, *euler.shape[-2:])
    from_euler = scipy.spatial.transform.Rotation.from_euler
    turn = from_euler("xyz", steps[:, 0])
    for step in range(1, steps.shape[1]):
        turn = from_euler("xyz", steps[:, step]) * turn
    return turn.as_euler("xyz").reshape(*euler.shape[:-2], 3)


def _rotation_groups(aggregation: Sequence[str]) -> list[int]:
    """Where each triple of Euler angles starts."""
    for kind in aggregation:
        if kind not in AGGREGATIONS:
            raise ValueError(f"unknown aggregation '{kind}'; known are {', '.join(AGGREGATIONS)}")
    groups, position = [], 0
    while position < len(aggregation):
        if aggregation[position] != "rotate":
            position += 1
            continue
        if list(aggregation[position : position + 3]) != ["rotate"] * 3:
            raise ValueError(f"'rotate' comes in threes (Euler xyz), not as in {tuple(aggregation)}")
        groups.append(position)
        position += 3
    return groups
