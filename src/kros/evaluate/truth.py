"""Errors against what states really were, and how late a signal is.

A recorded state may itself be an estimate: a drive's velocity is a filtered difference of positions, which trails. An
observer that was made to agree with the recording then trails as well, and its error against the recording does not
show it; error and lag against the truth do.
"""

from __future__ import annotations

import numpy as np

from ..core.arrays import Array, Whole, frozen
from .errors import error_percent, error_rms


@frozen
class TrueErrors:
    """Errors of signals against truths over a batch of episodes."""

    states: tuple[int, ...]  # column of the state that each truth is the truth of
    rms: Array  # (batch, n_truths)
    error_percent: Array  # (batch, n_truths): as that of `ErrorSummary`
    lag_s: Array  # (batch, n_truths), s: how late the signal is, see `delay_samples`; NaN where that is unknown


def true_errors(signals: Array, truths: Array, states: tuple[int, ...], lengths: Whole, dt: float) -> TrueErrors:
    """Return the errors of signals (n_samples, batch, n) against the truths of some states, and how late these are."""
    signals, lag = signals[..., list(states)], np.empty(truths.shape[1:])
    for length in np.unique(lengths):
        rows = lengths == length
        lag[rows] = delay_samples(signals[:length, rows], truths[:length, rows])
    return TrueErrors(states, error_rms(signals, truths, lengths), error_percent(signals, truths, lengths), lag * dt)


def delay_samples(signals: Array, truths: Array) -> Array:
    """Return the delay of truths, at most 200 samples, that fits signals best; a parabola refines the least cost."""
    from scipy.signal import fftconvolve

    n = len(signals)
    most = min(200, n // 4)  # samples
    if most < 1:
        return np.full(signals.shape[1:], np.nan)
    with np.errstate(divide="ignore", invalid="ignore"):
        y, x = (values - truths.mean(axis=0) for values in (signals[most : n - most], truths))
        common = fftconvolve(x, y[::-1], mode="valid", axes=0)
        energy = np.cumsum(np.concatenate([np.zeros((1, *x.shape[1:])), x**2]), axis=0)
        cost = energy[n - 2 * most :] - energy[: 2 * most + 1] - 2 * common
        best = cost.argmin(axis=0)
        middle = np.clip(best, 1, 2 * most - 1)
        left, least, right = (np.take_along_axis(cost, (middle + side)[None], axis=0)[0] for side in (-1, 0, 1))
        bend = left - 2 * least + right
        delay = most - middle - 0.5 * (left - right) / bend
    known = np.isfinite(signals).all(axis=0) & (np.ptp(x, axis=0) > 0) & (best == middle) & (bend > 0)
    return np.where(known, delay, np.nan)
