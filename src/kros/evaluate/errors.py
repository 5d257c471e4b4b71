"""Errors and spectra of estimates (section IV-E)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

Array = npt.NDArray[np.float64]
_SEGMENT = 512  # samples of a Welch segment, as in the paper


@dataclass(frozen=True, eq=False)
class ErrorSummary:
    """Errors of an estimate over a batch of episodes, each of shape (batch, n).

    Parameters
    ----------
    rms : ndarray
    percent : ndarray
        ``100 rms(x_hat - x) / max|x|`` of every episode.
    band_power : ndarray or None
        Power of the error in the band asked for.
    """

    rms: Array
    percent: Array
    band_power: Array | None


def summarise(estimate: Array, truth: Array, dt: float, band_hz: tuple[float, float] | None = None) -> ErrorSummary:
    """Summarise the error of an estimate.

    Parameters
    ----------
    estimate, truth : ndarray, shape (n_samples, batch, n)
    dt : float, s
    band_hz : tuple of float, optional
        Band over which the error's power is integrated.

    Returns
    -------
    ErrorSummary
        Not-a-number and infinite where the estimate diverged.
    """
    error = estimate - truth
    with np.errstate(over="ignore", invalid="ignore"):
        rms = np.sqrt(np.mean(error**2, axis=0))
    percent = 100 * rms / np.maximum(np.abs(truth).max(axis=0), np.finfo(float).tiny)
    band = None
    if band_hz is not None:
        freqs, spectrum = error_spectrum(error, dt)
        inside = (freqs >= band_hz[0]) & (freqs <= band_hz[1])
        band = spectrum[inside].sum(axis=0) * (freqs[1] - freqs[0])
    return ErrorSummary(rms, percent, band)


def error_spectrum(error: Array, dt: float) -> tuple[Array, Array]:
    """Return Welch's estimate of the error's power spectral density.

    Parameters
    ----------
    error : ndarray, shape (n_samples, ...)

    Returns
    -------
    freqs_hz : ndarray, shape (n_freqs,)
    density : ndarray, shape (n_freqs, ...)
    """
    from scipy.signal import welch

    length = min(_SEGMENT, len(error))
    with np.errstate(over="ignore", invalid="ignore"):
        freqs, density = welch(error, fs=1 / dt, nperseg=length, axis=0)
    return freqs, density
