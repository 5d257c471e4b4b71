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

from ..core import AnyArray, Array, DataError, Flags, frozen
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

    def mean_squares(self, innovation: Array, judged: Flags) -> Array:
        """Return mean squares of a machine, (n_samples, q, bands), after every sample; those not judged change none."""
        from scipy.signal import lfilter

        scaled = self.scaled(innovation[judged])
        bands = [lfilter([b, 0, -b], [1, a1, a2], scaled, axis=0) for b, a1, a2 in self.filters]
        means = self._remembered(np.stack(bands, axis=-1) ** 2)
        return np.concatenate([np.zeros((1, *self.limits.shape)), means])[np.cumsum(judged)]

    def scaled(self, innovation: Array) -> Array:
        """Return innovations (..., q) over their sizes, within what counts at most."""
        scaled = innovation / self.size
        return np.clip(np.where(np.isnan(scaled), LARGEST, scaled), -LARGEST, LARGEST)

    def in_turn(self, episodes: Sequence[tuple[Array, Flags]]) -> list[Array]:
        """Return the mean squares of episodes, (n_samples, q, bands), that a machine has one after the other."""
        innovation, judged = (np.concatenate(parts) for parts in zip(*episodes, strict=True))
        return np.split(self.mean_squares(innovation, judged), np.cumsum([len(own) for _, own in episodes])[:-1])

    def _remembered(self, squares: Array) -> Array:
        """Return the means of squares, shape (n_samples, q, bands), after every sample."""
        from scipy.signal import lfilter

        first, keep = max(self.first, self.forget), 1 - self.forget
        falling = min(len(squares), int(np.ceil(1 / self.forget - 1 / first)))  # until the gain stays as it is
        begun = np.cumsum(squares[:falling], axis=0) / (1 / first + np.arange(falling))[:, None, None]
        if falling == len(squares):
            return begun
        last = keep * begun[-1:] if falling else np.zeros((1, *squares.shape[1:]))
        rest, _ = lfilter([self.forget], [1, -keep], squares[falling:], axis=0, zi=last)
        return np.concatenate([begun, rest])

    def level(self, mean_squares: Array) -> Array:
        """Return the level over the bound in dB, (...), of mean squares (..., q, bands)."""
        levels = 10 * np.log10(np.maximum(mean_squares / self.limits, QUIET))
        return (levels * self.weights).sum(axis=(-2, -1)) / WEIGHT


def octaves(count: int = 6) -> Array:
    """Return band-pass filters of order two, (count, 3), an octave apart, from half the Nyquist frequency down."""
    w = 2 * np.pi * 0.256 / 2.0 ** np.arange(count)
    alpha = np.sin(w) / 2.8  # of quality 1.4
    return np.stack([alpha / (1 + alpha), -2 * np.cos(w) / (1 + alpha), (1 - alpha) / (1 + alpha)], axis=-1)


def judged_samples(settle: int, status: AnyArray, starts: Flags, moving: Flags) -> Flags:
    """Return which samples are judged, as a running observer does it; status and flags (n_samples, batch)."""
    judged, wait = np.zeros(status.shape, dtype=bool), np.zeros(status.shape[1], dtype=int)
    bad, quiet = status != 0, np.arange(len(status))[:, None]
    events = np.flatnonzero((bad | starts | ~moving).any(axis=1))  # the first sample, which is a start, is one
    for k, stop in pairwise([*events, len(status)]):
        judged[k], wait = judge(wait, settle, bad[k], starts[k], moving[k])
        judged[k + 1 : stop] = quiet[: stop - k - 1] >= wait
        wait = np.maximum(wait - (stop - k - 1), 0)
    return judged


def judge(wait: Any, settle: int, bad: Any, start: Any, moving: Any) -> tuple[Any, Any]:
    """Return which machines are judged at a sample, and how many more samples each is not."""
    wait = np.where(start, settle, wait)
    following = np.where(bad, np.minimum(wait + RECOVERY, settle), np.maximum(wait - 1, 0))
    return moving & ~bad & (wait == 0), np.where(moving, following, wait)


class Watch:
    """A monitor with its memory, on one machine."""

    def __init__(self, monitor: Monitor) -> None:
        self._monitor = monitor
        self.reset()

    def reset(self) -> None:
        """Forget everything."""
        self._filters, self._squares = np.zeros((2, *self._monitor.limits.shape)), np.zeros(self._monitor.limits.shape)
        self._gain, self.outside = max(self._monitor.first, self._monitor.forget), False
        self._wait: Any = self._monitor.settle

    def take(self, innovation: Array, bad: Any, start: Any, moving: Any) -> None:
        """Take the innovation of every channel, (q,); the flags are those of `judge`."""
        judged, self._wait = judge(self._wait, self._monitor.settle, bad, start, moving)
        if not judged:
            return
        b, a1, a2 = self._monitor.filters.T
        driven = b * self._monitor.scaled(innovation)[:, None]
        bands = driven + self._filters[0]
        self._filters = np.stack([self._filters[1] - a1 * bands, -driven - a2 * bands])
        self._squares = self._squares + self._gain * (bands**2 - self._squares)
        self._gain = max(self._gain / (1 + self._gain), self._monitor.forget)
        self.outside = self.level_db > 0

    @property
    def level_db(self) -> float:
        """Level of the innovation over its bound, dB; far below zero before anything was judged."""
        return float(self._monitor.level(self._squares))
