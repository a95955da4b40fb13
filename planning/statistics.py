"""What a handful of episodes says about a success rate, and about the difference of two.

Episodes of one setup resemble each other, and those of a controller without randomness are the same. So a setup is one
observation, however often it is repeated: with `n` setups and `N` episodes, an episode counts as n / N of one.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np


def wilson_interval(successes: float, trials: float, z: float = 1.959964) -> tuple[float, float]:
    """Wilson's score interval of a proportion (1927), which stays honest near 0 and 1.

    Args:
        successes: of `trials`; a trial may succeed in part.
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


@dataclass(frozen=True)
class Pairs:
    """How two competitors fared at the same tasks, counted by who succeeded."""

    both: float
    first: float
    """the first alone"""
    second: float
    """the second alone"""
    neither: float

    @classmethod
    def count(cls, first: list[bool], second: list[bool]) -> Pairs:
        """From the successes of both, task by task."""
        pairs = list(zip(first, second, strict=True))
        return cls(*(pairs.count(who) for who in ((True, True), (True, False), (False, True), (False, False))))

    @property
    def total(self) -> float:
        """Tasks."""
        return self.both + self.first + self.second + self.neither

    def counting_as(self, tasks: int) -> Pairs:
        """The same shares of fewer tasks, where some are the same again."""
        counts = (self.both, self.first, self.second, self.neither)
        return Pairs(*(tasks * count / self.total for count in counts)) if self.total else self

    @property
    def difference(self) -> float | None:
        """The first's share of successes less the second's; None without tasks."""
        return (self.first - self.second) / self.total if self.total else None

    def interval(self, z: float = 1.959964) -> tuple[float, float]:
        """Newcombe's interval of the difference for paired data (1998, method 10).

        It joins the Wilson intervals of the two shares and takes into account that the same tasks are easy for both.
        Unlike a bootstrap it has a width where all pairs fell out alike.

        Args:
            z: quantile of the normal distribution; 1.96 gives 95 %.

        Returns:
            low, high: in [-1, 1]; (-1, 1) without tasks.
        """
        if self.total == 0:
            return -1.0, 1.0
        ours, theirs = self.both + self.first, self.both + self.second
        low_a, high_a = _reach(ours, self.total, z)
        low_b, high_b = _reach(theirs, self.total, z)
        phi = self._correlation()
        middle = (self.first - self.second) / self.total
        down = math.sqrt(max(0.0, low_a**2 - 2 * phi * low_a * high_b + high_b**2))
        up = math.sqrt(max(0.0, low_b**2 - 2 * phi * low_b * high_a + high_a**2))
        return max(-1.0, middle - down), min(1.0, middle + up)

    def _correlation(self) -> float:
        """Of the two outcomes over tasks, a positive one corrected for continuity."""
        spread = (self.both + self.first) * (self.second + self.neither)
        spread *= (self.both + self.second) * (self.first + self.neither)
        if spread == 0:
            return 0.0
        together = float(self.both * self.neither - self.first * self.second)
        if together > 0:
            together = max(together - self.total / 2, 0.0)
        return together / math.sqrt(spread)


def sign_flip_p(differences: Sequence[int]) -> float:
    """Exact two-sided p-value that neither of two competitors is the better one.

    If neither is, each difference might as well have the other sign: the value is the share of all ways to choose the
    signs in which the sum is at least as far from 0 as it is. Of differences -1, 0 and 1 this is McNemar's exact test.

    Args:
        differences: by task, the first's successes less the second's.

    Returns:
        In (0, 1]; 1 if they never differ.
    """
    chances = np.ones(1)  # of each sum, from the least that can be to the greatest
    for size in map(abs, differences):
        either = np.zeros(2 * size + 1)
        either[0] += 0.5
        either[-1] += 0.5
        chances = np.convolve(chances, either)
    sums = np.arange(len(chances)) - len(chances) // 2
    return min(1.0, float(chances[np.abs(sums) >= abs(sum(differences))].sum()))


def _reach(successes: float, trials: float, z: float) -> tuple[float, float]:
    """How far Wilson's interval reaches down and up from the share itself."""
    low, high = wilson_interval(successes, trials, z)
    return successes / trials - low, high - successes / trials
