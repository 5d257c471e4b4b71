"""Errors and spectra of estimates (section IV-E)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

Array = npt.NDArray[np.float64]
START = 50  # samples in which an observer finds out what it does not know at first
_SEGMENT = 512  # samples of a Welch segment, as in the paper
_TOGETHER = 6  # episodes whose spectra are computed at once: their segments stay in the cache
_TURNED = 256  # samples of all signals that are put in order at once: they stay in the cache


@dataclass(frozen=True, eq=False)
class ErrorSummary:
    """Errors of an estimate over a batch of episodes."""

    rms: Array  # (batch, n)
    percent: Array  # (batch, n): `100 rms(x_hat - x) / max|x|` of every episode
    start_percent: Array  # (batch, n): of the first `START` samples, over the largest value of the episode
    rest_percent: Array  # (batch, n): the same of the samples behind
    spectra: Array  # (batch, n_freqs, n): Welch's power spectral density of the error
    freqs_hz: Array  # (n_freqs,)

    @classmethod
    def joined(cls, parts: Sequence[ErrorSummary]) -> ErrorSummary:
        """Return the summary of one batch after the other."""
        names = ("rms", "percent", "start_percent", "rest_percent", "spectra")
        return replace(parts[0], **{name: np.concatenate([getattr(part, name) for part in parts]) for name in names})

    def band_power(self, band_hz: tuple[float, float]) -> Array:
        """Return the error's power inside a band, shape (batch, n)."""
        inside = (self.freqs_hz >= band_hz[0]) & (self.freqs_hz <= band_hz[1])
        return self.spectra[:, inside].sum(axis=1) * (self.freqs_hz[1] - self.freqs_hz[0])


def summarise(estimate: Array, truth: Array, lengths: npt.NDArray[np.int64], dt: float) -> ErrorSummary:
    """Summarise the error of an estimate."""
    return summarise_all(estimate[None], truth, lengths, dt)[0]


def summarise_all(estimates: Array, truth: Array, lengths: npt.NDArray[np.int64], dt: float) -> list[ErrorSummary]:
    """Summarise errors of estimates, shape (estimate, n_samples, batch, n or more), otherwise as `summarise`."""
    with np.errstate(over="ignore", invalid="ignore"):
        return [_summary(estimate[..., : truth.shape[2]], truth, lengths, dt) for estimate in estimates]


def _summary(estimate: Array, truth: Array, lengths: npt.NDArray[np.int64], dt: float) -> ErrorSummary:
    error = _signals(estimate, truth)
    for signals, length in zip(error, lengths, strict=True):
        signals[:, length:] = 0.0
    spectra = np.empty((len(lengths), _SEGMENT // 2 + 1, error.shape[1]))
    for length in np.unique(lengths):
        episodes = np.flatnonzero(lengths == length)
        for rows in np.split(episodes, range(_TOGETHER, len(episodes), _TOGETHER)):
            spectra[rows] = np.swapaxes(error_spectrum(error[rows, :, :length], dt, axis=-1)[1], 1, 2)
    first, whole = (np.einsum("bns,bns->bn", part, part) for part in (error[..., :START], error))
    counts = (lengths, np.minimum(START, lengths), np.maximum(lengths - START, 1))
    squares = (whole, first, np.maximum(whole - first, 0.0))
    rms = [np.sqrt(sums / count[:, None]) for sums, count in zip(squares, counts, strict=True)]
    largest = _largest(truth, lengths)
    freqs = np.asarray(np.fft.rfftfreq(_SEGMENT, dt), dtype=float)
    percent, start, rest = (_percent(values, largest) for values in rms)
    return ErrorSummary(rms[0], percent, start, rest, spectra, freqs)


def _signals(estimate: Array, truth: Array) -> Array:
    """The error with every signal in one piece, shape (batch, n, n_samples)."""
    error = np.empty((*truth.shape[1:], len(truth)))
    for start in range(0, len(truth), _TURNED):
        part = slice(start, start + _TURNED)
        error[..., part] = np.moveaxis(estimate[part] - truth[part], 0, -1)
    return error


def error_rms(estimate: Array, truth: Array, lengths: npt.NDArray[np.int64]) -> Array:
    """Return the root mean square error of every episode, shape (batch, n); arguments as in `summarise`.

    Examples
    --------
    >>> import numpy as np
    >>> from kros.evaluate import error_rms
    >>> recorded = np.array([0.0, 2.0, -4.0]).reshape(3, 1, 1)  # sample, episode, state
    >>> error_rms(recorded + 0.1, recorded, np.array([3])).round(9).tolist()
    [[0.1]]
    """
    with np.errstate(over="ignore", invalid="ignore"):
        error = estimate - truth
        if np.any(lengths != len(truth)):
            error[np.arange(len(truth))[:, None] >= lengths] = 0.0
        return np.sqrt(np.einsum("kbn,kbn->bn", error, error) / lengths[:, None])


def error_percent(estimate: Array, truth: Array, lengths: npt.NDArray[np.int64]) -> Array:
    """Return ``100 rms(x_hat - x) / max|x|`` of every episode, shape (batch, n), NaN for a state at zero.

    Examples
    --------
    >>> import numpy as np
    >>> from kros.evaluate import error_percent
    >>> recorded = np.array([0.0, 2.0, -4.0]).reshape(3, 1, 1)  # sample, episode, state
    >>> error_percent(recorded + 0.1, recorded, np.array([3])).round(9).tolist()
    [[2.5]]
    """
    return _percent(error_rms(estimate, truth, lengths), _largest(truth, lengths))


def _largest(truth: Array, lengths: npt.NDArray[np.int64]) -> Array:
    """Largest absolute values of episodes, shape (batch, n)."""
    if np.all(lengths == len(truth)):
        return np.maximum(truth.max(axis=0), -truth.min(axis=0))
    return np.asarray(
        np.max(np.abs(truth), axis=0, where=np.arange(len(truth))[:, None, None] < lengths[:, None], initial=0.0)
    )


def _percent(rms: Array, largest: Array) -> Array:
    return np.divide(100 * rms, largest, out=np.full_like(rms, np.nan), where=largest > 0)


def error_spectrum(error: Array, dt: float, segment: int = _SEGMENT, axis: int = 0) -> tuple[Array, Array]:
    """Return Welch's estimate of the error's power spectral density: half overlapping Hann windows.

    Parameters
    ----------
    error : ndarray, shape (n_samples, ...)
        Samples on the first axis, or on that of `axis`.
    dt : float, s
    segment : int
        Samples of a segment; shorter signals are padded with zeros, so that all spectra have the same frequencies.
    axis : int

    Returns
    -------
    freqs_hz : ndarray, shape (n_freqs,)
    density : ndarray, shape (n_freqs, ...)
        One-sided: the powers of a frequency and its negative together.

    Examples
    --------
    >>> import numpy as np
    >>> from kros.evaluate import error_spectrum
    >>> tone = np.sin(2 * np.pi * 25 * 0.001 * np.arange(4000))
    >>> freqs_hz, density = error_spectrum(tone, 0.001, segment=400)
    >>> float(freqs_hz[density.argmax()])
    25.0
    """
    signal = np.moveaxis(np.asarray(error, dtype=float), axis, -1)
    size = min(segment, signal.shape[-1])
    window = _window(size)
    pieces = np.lib.stride_tricks.sliding_window_view(signal, size, axis=-1)[..., :: size - size // 2, :]
    spectra = np.fft.rfft((pieces - pieces.mean(axis=-1, keepdims=True)) * window, segment)
    density = _density(np.mean(spectra.real**2 + spectra.imag**2, axis=-2), window, segment, dt)
    return np.asarray(np.fft.rfftfreq(segment, dt), dtype=float), np.moveaxis(density, -1, axis)


def _window(size: int) -> Array:
    """Hann's window."""
    return np.asarray(0.5 - 0.5 * np.cos(2 * np.pi * np.arange(size) / size))


def _density(powers: Array, window: Array, segment: int, dt: float) -> Array:
    """The one-sided power spectral density of mean squares of transforms, frequencies last."""
    density = powers * (dt / max(np.sum(window**2), np.finfo(float).tiny))
    density[..., 1 : (segment + 1) // 2] *= 2  # all but zero and, of an even number, Nyquist
    return np.asarray(density)
