"""What users say about where an episode starts."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from envs.errors import UsageError


def option_numbers(name: str, value: Any, count: int) -> NDArray[np.float64]:
    """The value of a reset's option as (count,) float64.

    Raises:
        UsageError: it is not so many finite numbers.
    """
    try:
        numbers = np.asarray(value, np.float64)
    except (TypeError, ValueError) as error:
        raise UsageError(f"option {name} is {value!r}; give {count} numbers") from error
    if numbers.shape != (count,) or not np.isfinite(numbers).all():
        raise UsageError(f"option {name} is {value!r}; give {count} finite numbers")
    return numbers
