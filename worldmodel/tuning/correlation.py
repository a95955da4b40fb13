"""How well scores at small budgets foretell those at larger ones: the paper's rank-correlation figure."""

from __future__ import annotations

import itertools
import math
import warnings
from collections.abc import Sequence
from typing import Any

import numpy as np
import scipy  # its parts load when they are used

from worldmodel.scores import number
from worldmodel.tuning.journal import Trial

FEWEST = 3
"""Configurations from which a rank correlation can be told."""
MOST_ENUMERATED = 9
"""Configurations up to which p-values are exact; with more, the t-distribution comes near to them."""


def rank_correlations(trials: Sequence[Trial], budgets: Sequence[int]) -> list[dict[str, Any]]:
    """Spearman's rank correlation between every pair of budgets, over the trials that have scores at both.

    Args:
        trials: any; those that diverged before a budget have no score there and do not count.
        budgets: steps, rising.

    Returns:
        For each pair: `budgets`; `n`, the trials that count; `r` and `p` (two-sided, of no correlation; exact for few
        trials), None with fewer than three trials or where all scores are equal.
    """
    pairs = []
    for low, high in itertools.combinations(budgets, 2):
        both = [trial for trial in trials if low in trial.scores and high in trial.scores]
        r = p = math.nan
        if len(both) >= FEWEST:
            r, p = _spearman([t.scores[low] for t in both], [t.scores[high] for t in both])
        pairs.append({"budgets": [low, high], "r": number(float(r)), "p": number(float(p)), "n": len(both)})
    return pairs


def written(p: float) -> str:
    """A p-value for people: none is 0."""
    return "< 0.001" if p < 0.001 else f"{p:.3f}"


def _spearman(first: Sequence[float], second: Sequence[float]) -> tuple[float, float]:
    """r and p; NaN where either does not vary."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # constant scores: the answer is NaN
        r, p = scipy.stats.spearmanr(first, second)
    if math.isfinite(r) and len(first) <= MOST_ENUMERATED:
        p = _exact_p(scipy.stats.rankdata(first), scipy.stats.rankdata(second))
    return r, p


def _exact_p(first: Any, second: Any) -> float:
    """The share of all orders of the second ranks that correlate with the first as much as they do, or more."""
    first = first - first.mean()
    orders = np.array(list(itertools.permutations(second)))
    return float(np.mean(abs(orders @ first) >= abs(second @ first) - 1e-9))
