"""Velocity as most machines compute it: the difference of the position, low-passed."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from itertools import product

import numpy as np

from ...core import Array, Parameters, frozen
from ...data import EpisodeBatch


@frozen
class FilteredDifference:
    """Rates of measured states by filtered differences; all other states are not estimated."""

    n_states: int
    pairs: tuple[tuple[int, int], ...]  # position among the measurements, and the state that is its rate
    cutoff_hz: float  # of the low-pass, below half the sampling frequency
    sample_period_s: float
    scales: tuple[float, ...] = ()  # of every pair: the state over the rate, which units of measure decide; one

    def run(self, y: Array, u: Array, parameters: Parameters | None = None) -> Array:
        """Estimate the rates from y (n_samples, batch, q), from rest; (n_samples, batch, n), NaN for other states."""
        del u, parameters
        estimate, found = np.full((*y.shape[:2], self.n_states), np.nan), rates(y, self.cutoff_hz, self.sample_period_s)
        for (measurement, state), scale in zip(self.pairs, self.scales or [1.0] * len(self.pairs), strict=True):
            estimate[..., state] = scale * found[..., measurement]
        return estimate

    def scaled_to(self, batch: EpisodeBatch, measured: Sequence[int]) -> FilteredDifference:
        """Return the same with the scales that fit recordings best, so that units of measure do not matter."""
        y, inside = batch.measurements(measured, arrived=False), batch.inside
        found, states = rates(y, self.cutoff_hz, self.sample_period_s)[inside], batch.states[inside]
        both = [(found[:, i], states[:, j]) for i, j in self.pairs]
        return replace(self, scales=tuple(float(r @ x / (r @ r)) if r.any() else 1.0 for r, x in both))


def rates(y: Array, cutoff_hz: float, sample_period_s: float) -> Array:
    """Return the low-passed rates of measurements, (n_samples, batch, q), from rest."""
    from scipy.signal import butter, lfilter

    y, rate = hold_missing(y), np.zeros(y.shape)
    rate[2:] = np.diff(y[:-1], axis=0) / sample_period_s
    return lfilter(*butter(2, cutoff_hz, fs=1 / sample_period_s), rate, axis=0)


def followed(batch: EpisodeBatch, measured: Sequence[int]) -> tuple[tuple[int, int], ...]:
    """Return which states are rates of measured ones: these explain half of their variance, whatever the units."""
    y, inside = batch.measurements(measured, arrived=False), batch.inside
    states, dt = batch.states[inside].T, batch.sample_period_s
    share = np.zeros((len(measured), len(states)))
    for cutoff in cutoffs_hz(dt)[::4]:
        pairs = product(rates(y, cutoff, dt)[inside].T, states)
        share = np.maximum(share, np.reshape([_explained(*pair) for pair in pairs], share.shape))
    share[:, list(measured)] = 0.0
    best = [(i, int(j)) for i, j in enumerate(share.argmax(axis=1)) if share[i, j] > 0.5]  # explains most
    return tuple((i, j) for i, j in best if share[:, j].argmax() == i)


def _explained(rate: Array, state: Array) -> float:
    """Return the share of a state's variance that a rate of the same sign explains."""
    if not np.ptp(rate) or not np.ptp(state):
        return 0.0
    return max(float(np.corrcoef(rate, state)[0, 1]), 0.0) ** 2


def cutoffs_hz(sample_period_s: float) -> Array:
    """Return the cut-offs that are tried, log-spaced from a thousandth to nearly half of the sampling frequency."""
    return np.geomspace(1e-3, 0.45, 24) / sample_period_s


def hold_missing(y: Array) -> Array:
    """Return measurements, (n_samples, ...), with the last that arrived for those that are missing, zero before it."""
    there = np.isfinite(y)
    shape = (-1, *[1] * (y.ndim - 1))
    last = np.maximum.accumulate(np.where(there, np.arange(len(y)).reshape(shape), 0), axis=0)
    return np.take_along_axis(np.where(there, y, 0.0), last, axis=0)
