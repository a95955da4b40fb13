"""Actions as every environment takes them: finite numbers, so and so many, clipped to [-1, 1]."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from envs.errors import UsageError


def clip_action(action: ArrayLike, size: int, what: str) -> NDArray[np.float64]:
    """The action as (size,) float64, clipped to [-1, 1].

    Args:
        action: to check.
        size: how many numbers it has.
        what: those are, for who gave something else.

    Raises:
        UsageError: it does not have `size` finite numbers.
    """
    checked = _numbers(action)
    if checked.shape != (size,):
        raise UsageError(f"the action has shape {checked.shape}; give {size} numbers: {what}")
    if not np.isfinite(checked).all():
        raise UsageError(f"the action {checked.tolist()} is not finite; give numbers in [-1, 1]")
    return np.clip(checked, -1.0, 1.0)


def clip_sequences(actions: ArrayLike, size: int) -> NDArray[np.float64]:
    """Sequences of actions as (N, T, size) float64, clipped to [-1, 1].

    Raises:
        UsageError: they have another shape, are not finite, or are none.
    """
    checked = _numbers(actions)
    if checked.ndim != 3 or checked.shape[2] != size or not checked.size or not np.isfinite(checked).all():
        raise UsageError(f"actions have shape {checked.shape}; give finite numbers (N, T, {size}), N and T above 0")
    return np.clip(checked, -1.0, 1.0)


def _numbers(given: ArrayLike) -> NDArray[np.float64]:
    try:
        return np.asarray(given, np.float64)
    except (TypeError, ValueError) as error:  # words, or rows of different lengths
        raise UsageError(f"the action is {given!r}; give numbers in [-1, 1]") from error
