"""Velocity as most machines compute it: the difference of the position, low-passed."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

from ...data import EpisodeBatch

Array = npt.NDArray[np.float64]


@dataclass(frozen=True)
class FilteredDifference:
    """Rates of measured states by filtered differences; all other states are not estimated."""

    n_states: int
    pairs: tuple[tuple[int, int], ...]  # position among the measurements, and the state that is its rate
    cutoff_hz: float  # of the low-pass, below half the sampling frequency
    sample_period_s: float
    scales: tuple[float, ...] = ()  # of every pair: the state over the rate, which units of measure decide; one

    def run(self, y: Array, u: Array, parameters: Mapping[str, npt.ArrayLike] | None = None) -> Array:
        """Estimate the rates from y (n_samples, batch, q), from rest; (n_samples, batch, n), NaN for other states."""
        del u, parameters
        estimate = np.full((*y.shape[:2], self.n_states), np.nan)
        for number, (measurement, state) in enumerate(self.pairs):
            rate = np.zeros(y.shape[1::-1])
            rate[:, 2:] = np.diff(y[:-1, :, measurement].T, axis=1) / self.sample_period_s
            estimate[..., state] = (self.scales[number] if self.scales else 1.0) * self._smoothed(rate).T
        return estimate

    def _smoothed(self, signals: Array) -> Array:
        """Pass signals, shape (..., n_samples), through the filter, from rest."""
        from scipy.signal import butter, lfilter

        return np.asarray(lfilter(*butter(2, self.cutoff_hz, fs=1 / self.sample_period_s), signals))

    def scaled_to(self, batch: EpisodeBatch, measured: Sequence[int]) -> FilteredDifference:
        """Return the same with the scales that fit recordings best, so that units of measure do not matter."""
        states, y = batch.states, batch.measurements(measured, arrived=False)
        inside = (np.arange(len(y))[:, None] < batch.lengths).astype(float)
        found = replace(self, scales=()).run(y, y[..., :0])
        slopes = []
        for _, state in self.pairs:
            rate, truth = found[..., state] * inside, states[..., state] * inside
            largest = np.abs(rate).max(initial=0.0) or 1.0
            power = float(np.sum((rate / largest) ** 2))
            slopes.append(float(np.sum(rate / largest * truth)) / power / largest if power else 1.0)
        return replace(self, scales=tuple(slopes))


def followed(batch: EpisodeBatch, measured: Sequence[int], explained: float = 0.5) -> tuple[tuple[int, int], ...]:
    """Return which states are rates of measured ones: these explain a share of their variance, whatever the units."""
    states, y, sample_period_s = batch.states, batch.measurements(measured, arrived=False), batch.sample_period_s
    hidden = [j for j in range(states.shape[-1]) if j not in measured]
    inside = np.arange(len(y))[:, None] < batch.lengths
    share = np.zeros((len(measured), len(hidden)))
    for i, j in np.ndindex(share.shape):
        truth = states[..., hidden[j]][inside]
        truth = (truth - truth.mean()) / (np.abs(truth).max(initial=0.0) or 1.0)
        for cutoff in cutoffs_hz(sample_period_s)[::4]:
            rate = FilteredDifference(states.shape[-1], ((i, hidden[j]),), float(cutoff), sample_period_s).run(
                y, y[..., :0]
            )
            rate = rate[..., hidden[j]][inside]
            rate = (rate - rate.mean()) / (np.abs(rate).max(initial=0.0) or 1.0)
            power = float(rate @ rate) * float(truth @ truth)
            found = float(rate @ truth)
            share[i, j] = max(float(share[i, j]), found * abs(found) / power if power else 0.0)
    pairs = []
    for i in range(len(share)):
        j = int(share[i].argmax()) if hidden else 0
        if hidden and share[i, j] > explained and share[:, j].argmax() == i:
            pairs.append((i, hidden[j]))
    return tuple(pairs)


def cutoffs_hz(sample_period_s: float) -> Array:
    """Return the cut-offs that are tried, log-spaced from a thousandth to nearly half of the sampling frequency."""
    return np.geomspace(1e-3, 0.45, 24) / sample_period_s
