"""Errors and spectra of estimates (section IV-E)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

Array = npt.NDArray[np.float64]
_SEGMENT = 512  # samples of a Welch segment, as in the paper


@dataclass(frozen=True, eq=False)
class ErrorSummary:
    """Errors of an estimate over a batch of episodes.

    Parameters
    ----------
    rms : ndarray, shape (batch, n)
    percent : ndarray, shape (batch, n)
        ``100 rms(x_hat - x) / max|x|`` of every episode.
    spectra : ndarray, shape (batch, n_freqs, n)
        Welch's power spectral density of the error.
    freqs_hz : ndarray, shape (n_freqs,)
    """

    rms: Array
    percent: Array
    spectra: Array
    freqs_hz: Array

    def band_power(self, band_hz: tuple[float, float]) -> Array:
        """Return the error's power inside a band, shape (batch, n)."""
        inside = (self.freqs_hz >= band_hz[0]) & (self.freqs_hz <= band_hz[1])
        return self.spectra[:, inside].sum(axis=1) * (self.freqs_hz[1] - self.freqs_hz[0])


def summarise(estimate: Array, truth: Array, lengths: npt.NDArray[np.int64], dt: float) -> ErrorSummary:
    """Summarise the error of an estimate.

    Parameters
    ----------
    estimate, truth : ndarray, shape (n_samples, batch, n)
    lengths : ndarray, shape (batch,)
        Samples of every episode that count.
    dt : float, s

    Returns
    -------
    ErrorSummary
        Not-a-number or infinite where the estimate diverged.
    """
    rms, percent, spectra = [], [], []
    for i, length in enumerate(lengths):
        error = estimate[:length, i] - truth[:length, i]
        with np.errstate(over="ignore", invalid="ignore"):
            rms.append(np.sqrt(np.mean(error**2, axis=0)))
            percent.append(100 * rms[-1] / np.maximum(np.abs(truth[:length, i]).max(axis=0), np.finfo(float).tiny))
            freqs, density = error_spectrum(error, dt, int(min(_SEGMENT, lengths.min())))
        spectra.append(density)
    return ErrorSummary(np.array(rms), np.array(percent), np.array(spectra), freqs)


def error_spectrum(error: Array, dt: float, segment: int = _SEGMENT) -> tuple[Array, Array]:
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

    freqs, density = welch(error, fs=1 / dt, nperseg=segment, axis=0)
    return freqs, density
