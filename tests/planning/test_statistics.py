"""Intervals against published values (and scipy's)."""

import numpy as np
import pytest
from scipy.stats import binomtest

from planning.statistics import Pairs, wilson_interval


@pytest.mark.parametrize(
    ("hits", "trials", "low", "high"),
    [(47, 50, 0.8378, 0.9794), (0, 50, 0.0, 0.0713), (50, 50, 0.9287, 1.0), (5, 10, 0.2366, 0.7634)],
)
def test_known_values(hits, trials, low, high):
    assert wilson_interval(hits, trials) == pytest.approx((low, high), abs=1e-4)


def test_agrees_with_scipy():
    for hits in range(13):
        ours, theirs = wilson_interval(hits, 12), binomtest(hits, 12).proportion_ci(method="wilson")
        assert ours == pytest.approx((theirs.low, theirs.high), abs=1e-6)


def test_no_trials_say_nothing():
    assert wilson_interval(0, 0) == (0.0, 1.0)


@pytest.mark.parametrize(
    ("counts", "low", "high"),
    [((36, 12, 2, 0), 0.0569, 0.3404), ((14, 5, 0, 22), 0.0115, 0.2265)],  # Newcombe (1998); Altman (2000), table 6.2
)
def test_paired_difference_against_published_intervals(counts, low, high):
    assert Pairs(*counts).interval() == pytest.approx((low, high), abs=1e-4)
    both, first, second, neither = counts
    assert Pairs(both, second, first, neither).interval() == pytest.approx((-high, -low), abs=1e-4)


def test_paired_interval_covers_as_often_as_it_says():
    rng = np.random.default_rng(0)
    for chances in ((0.6, 0.35, 0.02, 0.03), (0.25, 0.25, 0.25, 0.25)):
        intervals = [Pairs(*counts).interval() for counts in rng.multinomial(28, chances, 400).tolist()]
        true = chances[1] - chances[2]
        assert 0.92 <= np.mean([low <= true <= high for low, high in intervals]) <= 0.99


def test_all_pairs_alike_still_leave_doubt():
    low, high = Pairs(0, 10, 0, 0).interval()
    assert high == 1 and 0.5 < low < 0.9


def test_mcnemar():
    assert Pairs(20, 12, 2, 16).p_value() == pytest.approx(0.0129, abs=1e-4)  # Armitage and Berry (1994)
    assert Pairs(5, 0, 0, 5).p_value() == 1


def test_pairs_are_counted_task_by_task():
    pairs = Pairs.count([True, True, False, False, True], [True, False, True, False, False])
    assert pairs == Pairs(1, 2, 1, 1) and pairs.difference == pytest.approx(0.2)
    assert Pairs.count([], []).difference is None and Pairs.count([], []).interval() == (-1, 1)
