r"""The monitor: whether a machine still moves as the population does, by the level of the innovation over octaves.

The innovation :math:`\nu = y - C\hat x` of every measured channel goes through band-pass filters an octave apart, and
the mean square of each band is remembered, :math:`p \leftarrow p + g\,(b^2 - p)`, with a gain :math:`g \leftarrow
\max(g / (1 + g), g_\infty)`: it is the mean of all samples so far, and an exponential one from :math:`1/g_\infty`
samples on. The machine is outside the population's envelope while

.. math:: \prod_{c,b} \max(p_{cb} / \ell_{cb},\ 0.01)^{k_{cb}} > 1,

that is while a weighted mean of the bands' levels in decibels exceeds its bound. The weights are whole numbers that sum
to `WEIGHT`: those of the mean that differs least from good machine to good machine (`design.monitor`). What differs in
one band alone averages out: on simulated drives such a mean found badly assembled ones four times as often as a
threshold for every band. A product needs no logarithm on the machine.

A sample that was missing, invalid or beyond a limit is not judged, nor are those in which the observer forgets it, or
its start: while they go by, all that the monitor remembers is held.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise
from typing import Any

import numpy as np

from ..core import Array, DataError, Flags, frozen
from .checked import floats

LARGEST = 1e3  # sizes of the innovation that count at most
RECOVERY = 4  # samples that are not judged after one that is not good
WEIGHT = 16  # of all bands together
QUIET = 0.01  # of its limit: a band that is more quiet says no more


@frozen
class Monitor:
    """What a monitor computes with, and how often it is wrong about good machines."""

    filters: Array  # (bands, 3): b, a1, a2 of ``b (1 - z^-2) / (1 + a1 z^-1 + a2 z^-2)``
    forget: float  # share of a mean square that a sample replaces in the long run
    settle: int  # samples after a start that are not judged
    size: Array  # (q,), what innovations are divided by: their RMS in training
    limits: Array  # (q, bands), mean squares at the bound
    weights: Array  # (q, bands), whole numbers, how often a band counts
    false_alarm_rate: float  # probability that one more good machine exceeds the bound, moved as those in training
    units: int = 0  # machines that the bound was found on
    first: float = 0.0  # share that the first sample replaces, later ones less, down to `forget`

    def __post_init__(self) -> None:
        arrays = {"filters": "finite numbers", "size": "positive and finite", "limits": "positive and finite"}
        arrays |= {"weights": "finite and not negative"}
        floats(self, "Monitor of an observer", **arrays)
        shapes, (bands, q) = [getattr(self, name).shape for name in arrays], (len(self.filters), self.size.size)
        if not bands or shapes != [(bands, 3), (q,), (q, bands), (q, bands)]:
            raise DataError(
                f"Monitor of an observer: {', '.join(arrays)} should have shapes (bands, 3), (q), (q, bands) and "
                f"(q, bands), found {shapes}."
            )
        whole = np.all(self.weights == np.round(self.weights)) and self.weights.sum() == WEIGHT
        if not (whole and 0 < self.forget <= 1 and 0 <= self.first <= 1 and self.settle >= 0):
            raise DataError(
                f"Monitor of an observer: weights should be whole and of sum {WEIGHT}, forget and first within 0 and "
                f"1, settle at least 0; found {self}."
            )

    def scaled(self, innovation: Array) -> Array:
        """Return innovations (..., q) over their sizes, within what counts at most."""
        scaled = innovation / self.size
        return np.clip(np.where(np.isnan(scaled), LARGEST, scaled), -LARGEST, LARGEST)

    def in_turn(self, episodes: Sequence[tuple[Array, Flags]]) -> list[Array]:
        """Return the mean squares of episodes, (n_samples, q, bands), that a machine has one after the other."""
        innovation, judged = (np.concatenate(parts) for parts in zip(*episodes, strict=True))
        return np.split(Watch(self).mean_squares(innovation, judged), np.cumsum([len(own) for _, own in episodes])[:-1])

    def level(self, mean_squares: Array) -> Array:
        """Return the level over the bound in dB, (...), of mean squares (..., q, bands)."""
        levels = 10 * np.log10(np.maximum(mean_squares / self.limits, QUIET))
        return (levels * self.weights).sum(axis=(-2, -1)) / WEIGHT


def octaves(count: int = 6) -> Array:
    """Return band-pass filters of order two, (count, 3), an octave apart, from half the Nyquist frequency down."""
    w = 2 * np.pi * 0.256 / 2.0 ** np.arange(count)
    alpha = np.sin(w) / 2.8  # of quality 1.4
    return np.stack([alpha / (1 + alpha), -2 * np.cos(w) / (1 + alpha), (1 - alpha) / (1 + alpha)], axis=-1)


def judged_samples(settle: int, bad: Flags, starts: Flags, moving: Flags, wait: Any = 0) -> tuple[Flags, Any]:
    """Return which samples are judged, flags (n_samples, batch) of `judge`, and how many more machines are not."""
    judged, wait, quiet = np.zeros(bad.shape, dtype=bool), wait + np.zeros(bad.shape[1], int), np.arange(len(bad))
    events = np.flatnonzero((bad | starts | ~moving).any(axis=1))
    for k, stop in pairwise([0, *events[events > 0], len(bad)]):
        judged[k], wait = judge(wait, settle, bad[k], starts[k], moving[k])
        judged[k + 1 : stop] = quiet[: stop - k - 1, None] >= wait
        wait = np.maximum(wait - (stop - k - 1), 0)
    return judged, wait


def judge(wait: Any, settle: int, bad: Any, start: Any, moving: Any) -> tuple[Any, Any]:
    """Return which machines are judged at a sample, and how many more samples each is not."""
    wait = np.where(start, settle, wait)
    following = np.where(bad, np.minimum(wait + RECOVERY, settle), np.maximum(wait - 1, 0))
    return moving & ~bad & (wait == 0), np.where(moving, following, wait)


class Watch:
    """A monitor with its memory, on one machine."""

    def __init__(self, monitor: Monitor) -> None:
        self._monitor = monitor
        self.begin()

    def begin(self) -> None:
        """Forget everything."""
        self._filters, self._squares = np.zeros((2, *self._monitor.limits.shape)), np.zeros(self._monitor.limits.shape)
        self._gain, self._wait = max(self._monitor.first, self._monitor.forget), self._monitor.settle

    def take(self, innovation: Array, bad: Flags, starts: Flags, moving: Flags) -> Flags:
        """Return after which samples, (n_samples,), it is outside; innovation (n_samples, q), flags of `judge`."""
        monitor = self._monitor
        if len(bad) > 1:
            bad, starts, moving = (of[:, None] for of in (bad, starts, moving))
            judged, (self._wait,) = judged_samples(monitor.settle, bad, starts, moving, self._wait)
            return np.asarray(monitor.level(self.mean_squares(innovation, judged[:, 0])) > 0)
        judged, self._wait = judge(self._wait, monitor.settle, bad[0], starts[0], moving[0])
        if judged:  # the same without `lfilter`, which would take longer than the step
            b, a1, a2 = monitor.filters.T
            driven = b * monitor.scaled(innovation[0])[:, None]
            bands = driven + self._filters[0]
            self._filters = np.stack([self._filters[1] - a1 * bands, -driven - a2 * bands])
            self._squares = self._squares + self._gain * (bands**2 - self._squares)
            self._gain = max(self._gain / (1 + self._gain), monitor.forget)
        return np.array([self.level_db > 0])

    def mean_squares(self, innovation: Array, judged: Flags) -> Array:
        """Return mean squares, (n_samples, q, bands), after every sample; those not judged change none."""
        from scipy.signal import lfilter

        scaled, before = self._monitor.scaled(innovation[judged]), self._squares[None]
        bands = np.empty((*scaled.shape, len(self._monitor.filters)))
        for i, (b, a1, a2) in enumerate(self._monitor.filters):
            state = self._filters[..., i]
            bands[..., i], state[...] = lfilter([b, 0, -b], [1, a1, a2], scaled, axis=0, zi=state)
        means = np.concatenate([before, self._remembered(bands**2)])
        self._squares = means[-1]
        return means[np.cumsum(judged)]

    def _remembered(self, squares: Array) -> Array:
        """Return the means of squares, shape (n_samples, q, bands), after every sample."""
        from scipy.signal import lfilter

        forget, least = self._monitor.forget, 1 / self._gain
        falling = min(len(squares), int(np.ceil(1 / forget - least)))  # until the gain stays as it is
        sums = self._squares * (least - 1) + np.cumsum(squares[:falling], axis=0)
        begun = sums / (least + np.arange(falling))[:, None, None]
        self._gain = max(1 / (least + falling), forget)
        if falling == len(squares):
            return begun
        last = (1 - forget) * (begun[-1:] if falling else self._squares[None])
        rest, _ = lfilter([forget], [1, forget - 1], squares[falling:], axis=0, zi=last)
        return np.concatenate([begun, rest])

    @property
    def level_db(self) -> float:
        """Level of the innovation over its bound in dB; far below zero before anything was judged."""
        return float(self._monitor.level(self._squares))
