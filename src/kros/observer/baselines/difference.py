"""Velocity as most machines compute it: the difference of the measured position, filtered by a Butterworth low-pass of second order."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from ...core.errors import ConfigError, DimensionError
from ...data.population import Channel

Array = npt.NDArray[np.float64]
_ORDER = 2
_LOWEST_HZ = 1.0
_HIGHEST = 0.45  # of the sampling frequency
_CANDIDATES = 24


@dataclass(frozen=True)
class FilteredDifference:
    """Rates of measured states by filtered differences; all other states are not estimated.

    Parameters
    ----------
    n_states : int
    pairs : tuple of (int, int)
        Position among the measurements, and the state that is its rate.
    cutoff_hz : float
        Of the low-pass, below half the sampling frequency.
    sample_period_s : float
    """

    n_states: int
    pairs: tuple[tuple[int, int], ...]
    cutoff_hz: float
    sample_period_s: float

    def __post_init__(self) -> None:
        if not 0 < self.cutoff_hz < 0.5 / self.sample_period_s:
            raise ConfigError(
                f"Filtered difference: the cut-off of {self.cutoff_hz:g} Hz should lie between 0 and {0.5 / self.sample_period_s:g} Hz, half the sampling "
                "frequency."
            )

    def run(self, y: Array, u: Array, parameters: Mapping[str, npt.ArrayLike] | None = None) -> Array:
        """Estimate the rates of a batch of episodes, at rest before the first sample.

        Parameters
        ----------
        y : ndarray, shape (n_samples, batch, q)
        u : ndarray
            Not looked at.
        parameters : mapping
            Not looked at.

        Returns
        -------
        ndarray, shape (n_samples, batch, n)
            Row k from measurements up to k - 1; NaN for states that are no rate of a measured one.
        """
        from scipy.signal import butter, lfilter

        del u, parameters
        if y.ndim != 3:
            raise DimensionError(f"Filtered difference: measurements should have shape (n_samples, batch, q), found {y.shape}.")
        b, a = butter(_ORDER, self.cutoff_hz, fs=1 / self.sample_period_s)
        estimate = np.full((*y.shape[:2], self.n_states), np.nan)
        for measurement, state in self.pairs:
            rate = np.zeros(y.shape[:2])
            rate[2:] = np.diff(y[:-1, :, measurement], axis=0) / self.sample_period_s
            estimate[..., state] = lfilter(b, a, rate, axis=0)
        return estimate


def rates(channels: Iterable[Channel], measured: Sequence[str]) -> tuple[tuple[int, int], ...]:
    """Return which states are rates of measured ones, told by their units, such as rad and rad/s.

    Parameters
    ----------
    channels : iterable of Channel
        The states, in order.
    measured : sequence of str
        Names of the measured states, in the order of the measurements.

    Returns
    -------
    tuple of (int, int)
        Index of the measurement and of the state; a unit that two measurements or two rates share names no pair.
    """
    states = list(channels)
    unit = {c.name: c.unit for c in states}
    pairs = []
    for i, name in enumerate(measured):
        wanted = f"{unit[name]}/s"
        found = [j for j, c in enumerate(states) if c.unit == wanted and c.name not in measured]
        alone = sum(unit[other] == unit[name] for other in measured) == 1
        if unit[name] and alone and len(found) == 1:
            pairs.append((i, found[0]))
    return tuple(pairs)


def cutoffs_hz(sample_period_s: float) -> Array:
    """Return the cut-offs that are tried, log-spaced from 1 Hz to nearly half the sampling frequency."""
    top = _HIGHEST / sample_period_s
    return np.geomspace(min(_LOWEST_HZ, top / 100), top, _CANDIDATES)
