"""Velocity as most machines compute it: the difference of the position, low-passed."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from ...core.arrays import Array, ArrayLike
from ...data import EpisodeBatch
from ...data.batch import hold_missing


@dataclass(frozen=True)
class FilteredDifference:
    """Rates of measured states by filtered differences; all other states are not estimated."""

    n_states: int
    pairs: tuple[tuple[int, int], ...]  # position among the measurements, and the state that is its rate
    cutoff_hz: float  # of the low-pass, below half the sampling frequency
    sample_period_s: float
    scales: tuple[float, ...] = ()  # of every pair: the state over the rate, which units of measure decide; one

    def run(self, y: Array, u: Array, parameters: Mapping[str, ArrayLike] | None = None) -> Array:
        """Estimate the rates from y (n_samples, batch, q), from rest; (n_samples, batch, n), NaN for other states."""
        from scipy.signal import butter, lfilter

        del u, parameters
        y, estimate = hold_missing(y), np.full((*y.shape[:2], self.n_states), np.nan)
        low_pass = butter(2, self.cutoff_hz, fs=1 / self.sample_period_s)
        for number, (measurement, state) in enumerate(self.pairs):
            rate = np.zeros(y.shape[1::-1])
            rate[:, 2:] = np.diff(y[:-1, :, measurement].T, axis=1) / self.sample_period_s
            estimate[..., state] = (self.scales[number] if self.scales else 1.0) * lfilter(*low_pass, rate).T
        return estimate

    def scaled_to(self, batch: EpisodeBatch, measured: Sequence[int]) -> FilteredDifference:
        """Return the same with the scales that fit recordings best, so that units of measure do not matter."""
        y, inside = batch.measurements(measured, arrived=False), np.arange(len(batch.states))[:, None] < batch.lengths
        rates, states = replace(self, scales=()).run(y, y[..., :0])[inside], batch.states[inside]
        power, along = (rates**2).sum(axis=0), (rates * states).sum(axis=0)
        return replace(self, scales=tuple(float(along[i] / power[i]) if power[i] else 1.0 for _, i in self.pairs))


def followed(batch: EpisodeBatch, measured: Sequence[int], explained: float = 0.5) -> tuple[tuple[int, int], ...]:
    """Return which states are rates of measured ones: these explain a share of their variance, whatever the units."""
    y, inside = batch.measurements(measured, arrived=False), np.arange(len(batch.states))[:, None] < batch.lengths
    states, n, dt = batch.states[inside], batch.states.shape[-1], batch.sample_period_s
    hidden = [j for j in range(n) if j not in measured]
    share = np.zeros((len(measured), n))
    for i in range(len(measured)):
        for cutoff in cutoffs_hz(dt)[::4]:
            rates = FilteredDifference(n, tuple((i, j) for j in hidden), float(cutoff), dt).run(y, y[..., :0])[inside]
            share[i] = np.maximum(share[i], [_explained(*pair) for pair in zip(rates.T, states.T, strict=True)])
    best = [(i, int(j)) for i, j in enumerate(share.argmax(axis=1)) if share[i, j] > explained]
    return tuple((i, j) for i, j in best if share[:, j].argmax() == i)


def _explained(rate: Array, state: Array) -> float:
    """Return the share of a state's variance that a rate of the same sign explains, zero for what is not estimated."""
    if np.isnan(rate).any() or not np.ptp(rate) or not np.ptp(state):
        return 0.0
    return max(float(np.corrcoef(rate, state)[0, 1]), 0.0) ** 2


def cutoffs_hz(sample_period_s: float) -> Array:
    """Return the cut-offs that are tried, log-spaced from a thousandth to nearly half of the sampling frequency."""
    return np.geomspace(1e-3, 0.45, 24) / sample_period_s
