"""Coloured noise: random sequences whose power falls as 1/f^beta, and the policy that acts by it."""

from __future__ import annotations

from typing import Any

import gymnasium
import numpy as np
from numpy.typing import NDArray


def coloured_noise(
    beta: float, shape: int | tuple[int, ...], rng: np.random.Generator, lowest: float = 0.0
) -> NDArray[np.float64]:
    """Gaussian noise of power spectral density 1/f^beta along the last axis, unit variance (Timmer & Koenig, 1995).

    The zero frequency is kept, at the power of the lowest one, so that a short series has a mean of its own: without
    it no sampled plan would ever go anywhere. Unit variance is that of all the rest.

    Args:
        beta: 0 is white, 1 pink, 2 red (a random walk's).
        shape: of the result, (..., T).
        rng: source of randomness; as the package `colorednoise` draws from it.
        lowest: frequency in cycles a step below which the spectrum is flat; at least 1/T.

    Returns:
        (..., T) float64.
    """
    shape = (shape,) if isinstance(shape, int) else tuple(shape)
    length = shape[-1]
    if length == 1:  # no colour to have
        return rng.standard_normal(shape)
    frequency = np.maximum(np.fft.rfftfreq(length), max(lowest, 1.0 / length))
    amplitude = frequency ** (-beta / 2.0)
    # The zero frequency is a constant offset, the Nyquist frequency counts once when the length is even.
    counted = amplitude[1:].copy()
    counted[-1] *= (1 + length % 2) / 2.0
    deviation = 2.0 * np.sqrt(np.sum(counted**2)) / length
    real = rng.normal(scale=amplitude, size=(*shape[:-1], len(frequency)))
    imaginary = rng.normal(scale=amplitude, size=(*shape[:-1], len(frequency)))
    for real_only in (0, -1) if length % 2 == 0 else (0,):
        imaginary[..., real_only] = 0.0
        real[..., real_only] *= np.sqrt(2.0)
    return np.fft.irfft(real + 1j * imaginary, n=length, axis=-1) / deviation


class NoisePolicy:
    """Every action number follows its own coloured noise: smooth wandering.

    Args:
        beta: colour, see `coloured_noise`.
        strength: standard deviation as a share of half the action range.
        block: steps drawn at a time; after so many a new, independent sequence starts.
    """

    def __init__(self, beta: float = 1.5, strength: float = 0.5, block: int = 512) -> None:
        self._beta, self._strength, self._block = beta, strength, block

    def reset(self, env: gymnasium.Env, rng: np.random.Generator) -> None:
        space = env.action_space
        assert isinstance(space, gymnasium.spaces.Box)
        self._low, self._high, self._rng = space.low.astype(np.float64), space.high.astype(np.float64), rng
        # A sign (gripper) is held by the noise's sign: a smooth command that seldom flips.
        self._signs = np.isin(np.arange(len(self._low)), getattr(env.unwrapped, "SIGNS", ()))
        self._step = self._block

    def act(self, obs: dict[str, Any]) -> NDArray[Any]:
        if self._step == self._block:
            self._noise = coloured_noise(self._beta, (len(self._low), self._block), self._rng)
            self._step = 0
        unit = self._strength * self._noise[:, self._step]
        unit = np.where(self._signs, np.sign(unit), unit)
        self._step += 1
        centre, half = (self._high + self._low) / 2, (self._high - self._low) / 2
        return np.clip(centre + half * unit, self._low, self._high).astype(np.float32)
