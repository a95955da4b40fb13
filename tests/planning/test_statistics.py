"""Intervals against published values (and scipy's)."""

import itertools

import numpy as np
import pytest
from scipy.stats import binomtest

from planning.statistics import Pairs, sign_flip_p, wilson_interval


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
    assert sign_flip_p([0] * 36 + [1] * 12 + [-1] * 2) == pytest.approx(0.0129, abs=1e-4)  # Armitage and Berry (1994)
    assert sign_flip_p([0] * 10) == sign_flip_p([]) == 1
    for first, second in itertools.product(range(8), range(8)):
        if first + second:
            theirs = binomtest(first, first + second).pvalue
            assert sign_flip_p([1] * first + [-1] * second) == pytest.approx(theirs, abs=1e-12)


def test_signs_are_flipped_setup_by_setup():
    differences = [3, -1, 2, 0, 5, 1, -2]
    sums = [np.dot(signs, differences) for signs in itertools.product((-1, 1), repeat=len(differences))]
    assert sign_flip_p(differences) == pytest.approx(np.mean(np.abs(sums) >= sum(differences)))
    assert sign_flip_p([5, 5, 5, 0, 0]) == pytest.approx(0.25) == sign_flip_p([1, 1, 1, 0, 0])


def test_pairs_that_are_the_same_again_add_nothing():
    once, often = Pairs(5, 3, 0, 2), Pairs(25, 15, 0, 10)
    assert often.difference == once.difference and often.counting_as(10) == once
    assert often.counting_as(10).interval() == once.interval()
    assert Pairs(0, 0, 0, 0).counting_as(0).interval() == (-1, 1)


def test_intervals_cover_as_often_as_they_say_however_alike_repeats_are():
    rng = np.random.default_rng(0)
    setups, repeats = 20, 5
    for sharpness in (0.1, 1.0, 100.0):  # of how easy setups are: all or nothing, anything, alike
        easy = rng.beta(0.7 * sharpness, 0.3 * sharpness, (1000, setups))
        shares = rng.binomial(repeats, easy).sum(1) / repeats
        intervals = [wilson_interval(share, setups) for share in shares]
        assert np.mean([low <= 0.7 <= high for low, high in intervals]) >= 0.93


def test_pairs_are_counted_task_by_task():
    pairs = Pairs.count([True, True, False, False, True], [True, False, True, False, False])
    assert pairs == Pairs(1, 2, 1, 1) and pairs.difference == pytest.approx(0.2)
    assert Pairs.count([], []).difference is None and Pairs.count([], []).interval() == (-1, 1)
