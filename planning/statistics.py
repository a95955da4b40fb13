"""What a handful of episodes says about a success rate."""

from __future__ import annotations

import math


def wilson_interval(successes: int, trials: int, z: float = 1.959964) -> tuple[float, float]:
    """Wilson's score interval of a proportion (1927), which stays honest near 0 and 1.

    Args:
        successes: of `trials`.
        trials: independent attempts.
        z: quantile of the normal distribution; 1.96 gives 95 %.

    Returns:
        low, high: in [0, 1]; (0, 1) without trials.
    """
    if trials == 0:
        return 0.0, 1.0
    share = successes / trials
    scale = 1 + z**2 / trials
    centre = (share + z**2 / (2 * trials)) / scale
    half = z / scale * math.sqrt(share * (1 - share) / trials + z**2 / (4 * trials**2))
    return max(0.0, centre - half), min(1.0, centre + half)
