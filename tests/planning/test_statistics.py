"""Wilson's interval against published values (and scipy's)."""

import pytest
from scipy.stats import binomtest

from planning.statistics import wilson_interval


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
