"""Errors and spectra of estimates (section IV-E)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any, TypeVar

import numpy as np

from ..core.arrays import Array, Whole, frozen

T = TypeVar("T")
_SEGMENT = 512  # samples of a Welch segment, as in the paper


@frozen
class ErrorSummary:
    """Errors of an estimate over a batch of episodes."""

    rms: Array  # (batch, n)
    percent: Array  # (batch, n): `100 rms(x_hat - x) / max|x|` of every episode
    spectra: Array  # (batch, n_freqs, n): Welch's power spectral density of the error
    freqs_hz: Array  # (n_freqs,)

    def band_power(self, band_hz: tuple[float, float]) -> Array:
        """Return the error's power inside a band, shape (batch, n)."""
        inside = (self.freqs_hz >= band_hz[0]) & (self.freqs_hz <= band_hz[1])
        return self.spectra[:, inside].sum(axis=1) * (self.freqs_hz[1] - self.freqs_hz[0])


def joined(parts: Sequence[T], *names: str) -> T:
    """Return errors of one batch after the other, with some fields for all of them."""
    changed: Any = {name: np.concatenate([getattr(part, name) for part in parts]) for name in names}
    return replace(parts[0], **changed)  # type: ignore[type-var]


def summarise(estimates: Array, truth: Array, lengths: Whole, dt: float) -> list[ErrorSummary]:
    """Summarise errors of estimates, shape (estimate, n_samples, batch, n or more), against (n_samples, batch, n)."""
    with np.errstate(over="ignore", invalid="ignore"):
        return [_summary(estimate[..., : truth.shape[2]], truth, lengths, dt) for estimate in estimates]


def _summary(estimate: Array, truth: Array, lengths: Whole, dt: float) -> ErrorSummary:
    error = np.ascontiguousarray(np.moveaxis(estimate - truth, 0, -1))  # (batch, n, n_samples)
    spectra = np.empty((len(lengths), _SEGMENT // 2 + 1, error.shape[1]))
    for length in np.unique(lengths):
        rows = lengths == length
        error[rows, :, length:] = 0.0
        spectra[rows] = np.swapaxes(error_spectrum(error[rows, :, :length], dt, axis=-1)[1], 1, 2)
    rms = np.sqrt(np.einsum("bns,bns->bn", error, error) / lengths[:, None])
    freqs_hz = np.asarray(np.fft.rfftfreq(_SEGMENT, dt), dtype=float)
    return ErrorSummary(rms, _percent(rms, largest(truth, lengths)), spectra, freqs_hz)


def error_rms(estimate: Array, truth: Array, lengths: Whole) -> Array:
    """Return the root mean square error of every episode, shape (batch, n); arguments as in `summarise`."""
    with np.errstate(over="ignore", invalid="ignore"):
        error = estimate - truth
        if np.any(lengths != len(truth)):
            error[np.arange(len(truth))[:, None] >= lengths] = 0.0
        return np.sqrt(np.einsum("kbn,kbn->bn", error, error) / lengths[:, None])


def error_percent(estimate: Array, truth: Array, lengths: Whole) -> Array:
    """Return ``100 rms(x_hat - x) / max|x|`` of every episode, shape (batch, n), NaN for a state at zero.

    Examples
    --------
    >>> import numpy as np
    >>> from kros.evaluate import error_percent
    >>> recorded = np.array([0.0, 2.0, -4.0]).reshape(3, 1, 1)  # sample, episode, state
    >>> error_percent(recorded + 0.1, recorded, np.array([3])).round(9).tolist()
    [[2.5]]
    """
    return _percent(error_rms(estimate, truth, lengths), largest(truth, lengths))


def largest(truth: Array, lengths: Whole) -> Array:
    """Return the largest absolute values of episodes, shape (batch, n)."""
    if np.all(lengths == len(truth)):
        return np.maximum(truth.max(axis=0), -truth.min(axis=0))
    return np.max(np.abs(truth), axis=0, where=np.arange(len(truth))[:, None, None] < lengths[:, None], initial=0.0)


def _percent(rms: Array, largest: Array) -> Array:
    return np.divide(100 * rms, largest, out=np.full_like(rms, np.nan), where=largest > 0)


def error_spectrum(error: Array, dt: float, segment: int = _SEGMENT, axis: int = 0) -> tuple[Array, Array]:
    """Return frequencies and one-sided power density of an error by Welch's method: half overlapping Hann windows."""
    from scipy.signal import welch

    values = np.asarray(error, dtype=float)
    freqs_hz, density = welch(values, 1 / dt, nperseg=min(segment, values.shape[axis]), nfft=segment, axis=axis)
    return np.asarray(freqs_hz), np.asarray(density)
