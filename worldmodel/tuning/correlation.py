"""How well scores at small budgets foretell those at larger ones: the paper's rank-correlation figure."""

from __future__ import annotations

import itertools
import math
import warnings
from collections.abc import Sequence
from typing import Any

from scipy.stats import spearmanr

from worldmodel.tuning.journal import Trial

FEWEST = 3
"""Configurations from which a rank correlation can be told."""


def rank_correlations(trials: Sequence[Trial], budgets: Sequence[int]) -> list[dict[str, Any]]:
    """Spearman's rank correlation between every pair of budgets, over the trials that have scores at both.

    Args:
        trials: any; those that diverged before a budget have no score there and do not count.
        budgets: steps, rising.

    Returns:
        For each pair: `budgets`; `n`, the trials that count; `r` and `p` (two-sided, of no correlation), None with
        fewer than three trials or where all scores are equal.
    """
    pairs = []
    for low, high in itertools.combinations(budgets, 2):
        both = [trial for trial in trials if low in trial.scores and high in trial.scores]
        r = p = math.nan
        if len(both) >= FEWEST:
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")  # constant scores: the answer is NaN
                r, p = spearmanr([t.scores[low] for t in both], [t.scores[high] for t in both])
        pairs.append({"budgets": [low, high], "r": _number(r), "p": _number(p), "n": len(both)})
    return pairs


def written(p: float) -> str:
    """A p-value for people: none is 0."""
    return "< 0.001" if p < 0.001 else f"{p:.3f}"


def _number(value: float) -> float | None:
    return float(value) if math.isfinite(value) else None
