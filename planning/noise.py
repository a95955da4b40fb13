"""Noise whose power falls with frequency: what makes sampled arm motions smooth."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray


def coloured_noise(beta: float, shape: tuple[int, ...], rng: np.random.Generator) -> NDArray[np.float64]:
    """Gaussian noise with power spectrum `f ** -beta` along the last axis (Timmer & Koenig, 1995).

    The spectrum is drawn and brought to time by one inverse FFT for all series together. The component at frequency
    zero is kept, at the power of the lowest frequency, so a series has a mean of its own over the horizon; scaled so
    that the rest has unit variance.

    Args:
        beta: exponent; 0 is white noise, 3 is smooth enough for manipulation.
        shape: shape of the result; time is the last axis.
        rng: where the randomness comes from.

    Returns:
        noise: `shape`, float64, without unit.
    """
    steps = shape[-1]
    if steps == 1:
        return rng.standard_normal(shape)
    frequency = np.fft.rfftfreq(steps)
    frequency[0] = frequency[1]
    amplitude = frequency ** (-beta / 2)

    spectrum = rng.standard_normal((*shape[:-1], len(frequency), 2)) @ np.array([1, 1j]) * amplitude
    edges = [0] if steps % 2 else [0, -1]  # the frequencies of a real series that have no imaginary part
    spectrum[..., edges] = spectrum[..., edges].real * np.sqrt(2)

    power = amplitude[1:] ** 2
    if steps % 2 == 0:
        power[-1] /= 4  # the Nyquist frequency has no negative twin
    deviation = 2 * np.sqrt(power.sum()) / steps
    return np.fft.irfft(spectrum, n=steps, axis=-1) / deviation
