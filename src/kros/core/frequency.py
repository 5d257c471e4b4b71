"""Frequency grids."""

import numpy as np

from .arrays import Array
from .errors import ConfigError


def nyquist_hz(sample_period_s: float) -> float:
    """Return half the sampling frequency, Hz."""
    if not sample_period_s > 0:
        raise ConfigError(f"Nyquist frequency: needs a positive sampling period, found {sample_period_s} s.")
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
