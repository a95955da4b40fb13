"""Coloured noise against the package `colorednoise`, the referee."""

import colorednoise
import numpy as np
import pytest

from data_collection.policies.coloured_noise import coloured_noise

SERIES = 20_000


@pytest.mark.parametrize("beta", [0.0, 2.0, 3.0])
@pytest.mark.parametrize("steps", [2, 3, 10, 11, 30])
def test_spectrum_is_the_referees(beta, steps):
    ours = coloured_noise(beta, (SERIES, steps), np.random.default_rng(0))
    theirs = colorednoise.powerlaw_psd_gaussian(beta, (SERIES, steps), random_state=1)

    def spectrum(x):
        return (np.abs(np.fft.rfft(x, axis=-1)) ** 2).mean(axis=0)

    np.testing.assert_allclose(spectrum(ours), spectrum(theirs), rtol=0.06)
    assert ours.std() == pytest.approx(theirs.std(), rel=0.03)


def test_a_series_keeps_its_own_mean():
    noise = coloured_noise(3.0, (SERIES, 10), np.random.default_rng(0))
    assert np.sqrt((noise.mean(axis=-1) ** 2).mean()) == pytest.approx(0.65, abs=0.02)
    assert noise.std() == pytest.approx(1.19, abs=0.02)


def test_one_step_is_white_and_leading_dimensions_stay():
    rng = np.random.default_rng(0)
    assert coloured_noise(3.0, (SERIES, 1), rng).std() == pytest.approx(1, abs=0.02)
    assert coloured_noise(3.0, (4, 3, 7), rng).shape == (4, 3, 7)


def test_same_generator_same_noise():
    a, b = (coloured_noise(2.5, (5, 8), np.random.default_rng(3)) for _ in range(2))
    np.testing.assert_array_equal(a, b)
