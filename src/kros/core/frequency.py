"""Frequency grids."""

from __future__ import annotations

import numpy as np

from .arrays import Array, ArrayLike
from .errors import ConfigError
from .rounding import ROUNDING


def nyquist_hz(sample_period_s: float) -> float:
    """Return half the sampling frequency, Hz."""
    if not sample_period_s > 0:
        problem = f"the sampling period should be positive, found {sample_period_s} s"
        raise ConfigError(f"Nyquist frequency: {problem}; only discrete systems have one.")
    return 0.5 / sample_period_s


def log_grid(
    sample_period_s: float, n_freqs: int = 1000, decades: float = 6.0, longest_s: float | None = None
) -> Array:
    """Return logarithmic frequencies up to Nyquist, Hz, from the lowest that a recording of some length holds."""
    top = nyquist_hz(sample_period_s)
    low = max(top * 10.0**-decades, 0.0 if longest_s is None else 1 / longest_s)
    grid = np.geomspace(min(low, top / 2), top, n_freqs)
    grid[-1] = top
    return grid


def check_grid(freqs_hz: ArrayLike, sample_period_s: float | None) -> Array:
    """Return the frequencies as an array, or say why they are no grid; without a sampling period of continuous time."""
    freqs = np.atleast_1d(np.asarray(freqs_hz, dtype=float))
    top = np.inf if sample_period_s is None else nyquist_hz(sample_period_s)
    if freqs.ndim != 1 or freqs.size == 0 or not np.isfinite(freqs).all():
        problem = f"found shape {freqs.shape} with {np.isnan(freqs).sum()} NaN"
        raise ConfigError(f"Frequency grid: needs a list of finite frequencies in Hz, {problem}.")
    if np.any(np.diff(freqs) <= 0) or freqs[0] < 0 or (sample_period_s is None and freqs[-1] == 0):
        problem = f"frequencies should increase from zero or above, found {freqs[:5]} ... {freqs[-1]} Hz"
        raise ConfigError(f"Frequency grid: {problem}; sort them and drop doubles.")
    if freqs[-1] > top * (1 + ROUNDING):
        limit = f"the Nyquist frequency {top} Hz of the sampling period {sample_period_s} s"
        raise ConfigError(f"Frequency grid: {freqs[-1]} Hz is above {limit}; end the grid there.")
    return freqs
