"""Errors against what states really were, and how late a signal is.

A recorded state may itself be an estimate: a drive's velocity is a filtered difference of positions, which trails. An
observer that was made to agree with the recording then trails as well, and its error against the recording does not
show it; error and lag against the truth do.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from .errors import error_percent, error_rms

Array = npt.NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class TrueErrors:
    """Errors of signals against truths over a batch of episodes."""

    states: tuple[int, ...]  # column of the state that each truth is the truth of
    rms: Array  # (batch, n_truths)
    error_percent: Array  # (batch, n_truths): as that of `ErrorSummary`
    lag_s: Array  # (batch, n_truths), s: how late the signal is, see `delay_samples`; NaN where that is unknown

    @classmethod
    def joined(cls, parts: Sequence[TrueErrors]) -> TrueErrors:
        """Return the errors of one batch after the other."""
        names = ("rms", "error_percent", "lag_s")
        return cls(parts[0].states, *(np.concatenate([getattr(part, name) for part in parts]) for name in names))


def true_errors(
    signals: Array, truths: Array, states: tuple[int, ...], lengths: npt.NDArray[np.int64], dt: float
) -> TrueErrors:
    """Return the errors of signals (n_samples, batch, n) against the truths of some states, and how late these are."""
    signals, lag = signals[..., list(states)], np.empty(truths.shape[1:])
    for length in np.unique(lengths):
        rows = lengths == length
        lag[rows] = delay_samples(signals[:length, rows], truths[:length, rows])
    return TrueErrors(states, error_rms(signals, truths, lengths), error_percent(signals, truths, lengths), lag * dt)


def delay_samples(signals: Array, truths: Array, longest: int = 200) -> Array:
    """Return the delay of truths, at most `longest`, that fits signals best; a parabola refines the least cost."""
    from scipy.fft import irfft, next_fast_len, rfft

    n = len(signals)
    most = min(longest, n // 4)
    found = np.full(signals.shape[1:], np.nan)
    y, x = (np.moveaxis(a, 0, -1).reshape(-1, n) for a in (signals, truths))
    usable = np.isfinite(y).all(axis=-1) & (np.ptp(x, axis=-1) > 0)
    if most < 1 or not usable.any():
        return found
    y, x = (a[usable] - x[usable].mean(axis=-1, keepdims=True) for a in (y, x))
    inside = y.copy()
    inside[:, :most] = inside[:, n - most :] = 0.0
    size = next_fast_len(n, real=True)
    common = irfft(rfft(inside, size) * rfft(x, size).conj(), size)[:, np.arange(-most, most + 1)]
    energy = np.cumsum(np.pad(x**2, ((0, 0), (1, 0))), axis=-1)
    begin = most - np.arange(-most, most + 1)
    cost = energy[:, begin + n - 2 * most] - energy[:, begin] - 2 * common
    best = cost.argmin(axis=-1)
    middle = np.clip(best, 1, 2 * most - 1)
    left, least, right = (np.take_along_axis(cost, (middle + side)[:, None], axis=-1)[:, 0] for side in (-1, 0, 1))
    bend = left - 2 * least + right
    with np.errstate(divide="ignore", invalid="ignore"):
        delay = np.where((best == middle) & (bend > 0), middle - most + 0.5 * (left - right) / bend, np.nan)
    flat = found.reshape(-1)
    flat[usable.reshape(-1)] = delay
    return flat.reshape(found.shape)
