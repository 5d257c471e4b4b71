"""Delay-free low-pass filtering and resampling: plain numerics behind the preparation steps."""

from __future__ import annotations

import math

import numpy as np
import numpy.typing as npt
from scipy.signal import fftconvolve

Float = npt.NDArray[np.float64]

_DIRECT = 2000  # half length from which on convolution by FFT is faster by orders
PASSBAND = 0.8  # cutoff of the anti-alias filter as a share of the new Nyquist frequency


def lowpass(values: Float, cutoff: float) -> Float:
    """Filter columns without delay by a windowed sinc; ends are extended by odd reflection.

    Parameters
    ----------
    values : ndarray, shape (n_samples, n_channels)
    cutoff : float
        Half-amplitude frequency in cycles per sample; 0.5 or more leaves the values alone.

    Returns
    -------
    ndarray, shape (n_samples, n_channels)
    """
    n = len(values)
    half = min(math.ceil(4 / cutoff), n - 1) if cutoff > 0 else 0
    if cutoff >= 0.5 or half < 1:
        return values
    k = np.arange(-half, half + 1)
    taps = np.sinc(2 * cutoff * k) * np.hamming(2 * half + 1)
    taps /= taps.sum()
    padded = np.concatenate([2 * values[0] - values[half:0:-1], values, 2 * values[-1] - values[-2 : -half - 2 : -1]])
    if half > _DIRECT:
        return np.column_stack([fftconvolve(column, taps, mode="valid") for column in padded.T])
    return np.column_stack([np.convolve(column, taps, mode="valid") for column in padded.T])


def resample_even(time_s: Float, values: Float, median_s: float, period_s: float) -> Float:
    """Bring samples at increasing times to an even grid from the first time on.

    Parameters
    ----------
    time_s : ndarray, shape (n_samples,), s
    values : ndarray, shape (n_samples, n_channels)
    median_s : float
        Median step of `time_s`.
    period_s : float
        Step of the grid; above `median_s` the values are filtered below the new Nyquist frequency first.

    Returns
    -------
    ndarray, shape (n_new, n_channels)
    """
    finer = math.ceil(period_s / median_s - 1e-3)
    step = period_s / finer
    count = math.floor((time_s[-1] - time_s[0]) / step + 1e-6) + 1
    grid = time_s[0] + step * np.arange(count)
    fine = np.column_stack([np.interp(grid, time_s, column) for column in values.T])
    return fine if finer == 1 else np.ascontiguousarray(lowpass(fine, PASSBAND * 0.5 / finer)[::finer])
