r"""Plausibility of samples: missing, wrong and implausible ones, judged alike for batches and for one machine.

A sample is judged by itself, before the observer sees it:

| what arrives | what the observer takes | status |
|---|---|---|
| a measurement that is missing or not finite | nothing: it corrects nothing | `MISSING` |
| an input that is not finite | the last good one, going on with its last change; zero before | `INVALID_INPUT` |
| a sample beyond a declared limit | the limit | `LIMIT` |
| a sample beyond 1.5 times its range | as if it were missing, or not finite | `LIMIT` |

The range is the largest size seen in training, or that of the declared limits; without either a sample has none. So
nothing that is far from anything possible enters a state, linear or lifted, and what is left of a fault is what the
model misses while it lasts.

Of a filter bank's input training says by which factor p a change is followed by the next one, and j samples after the
last good one u stands :math:`u + (p + \dots + p^j) \Delta u`. For other observers p is one, five samples on.

Observers start at a measurement, filter banks at all of them. Where none has arrived yet, or no value of some input,
the estimate is that from the mean first state of training with the inputs that are known, and the observer starts again
at the first sample at which there are both. It does so, too, after an input was held for
more than a few samples: what a held reference does to an observer that watches tracking errors grows with every sample,
and a start costs no more than a start. Parameters stay.
"""

from __future__ import annotations

from dataclasses import replace
from enum import IntFlag

import numpy as np

from ..core import DataError, DimensionError, shortened
from ..core.arrays import Array, ArrayLike, Bits, Flags, Index, as_numbers, frozen
from .data import ObserverData
from .runtime import Seen

BEYOND = 1.5  # times the range: what is further away is implausible
LONGEST = 5  # samples for which an input may be lost; after more, all but filter banks start anew
NEVER = 2**32 - 1  # samples since an input that was never known


class SampleStatus(IntFlag):
    """What was wrong with a sample; bits add up.

    GOOD
        Nothing.
    MISSING
        A measurement is missing or not finite. It corrected nothing.
    INVALID_INPUT
        An input is not finite. The last good value and change stood for it.
    LIMIT
        A sample is beyond its limit or 1.5 times its range or was refused (see `filter_bank`), or the estimate or the
        correction met a limit that is declared.
    UNCERTIFIED
        Outside what the observer is certified for: the innovation is beyond the envelope of the population (see
        `monitor`).
    RESTARTED
        The estimate left its bounds, as it may while samples are lost: the observer waits for a good sample to start
        at, or that start has not settled yet.

    Examples
    --------
    >>> from kros.observer import SampleStatus
    >>> status = SampleStatus.MISSING | SampleStatus.LIMIT
    >>> SampleStatus.MISSING in status, SampleStatus.UNCERTIFIED in status
    (True, False)
    """

    GOOD = 0
    MISSING = 1
    INVALID_INPUT = 2
    LIMIT = 4
    UNCERTIFIED = 8
    RESTARTED = 16


@frozen
class Held:
    """Last good inputs, and their last changes in a sample."""

    inputs: Array  # (batch, m)
    slopes: Array  # (batch, m)
    since: Index  # (batch, m)
    stale: Flags  # (batch,)

    @classmethod
    def nothing(cls, batch: int, m: int) -> Held:
        """Return what is known before the first sample."""
        none = np.zeros((batch, m))
        return cls(none, none, np.full((batch, m), NEVER), np.ones(batch, dtype=bool))


@frozen
class Screened:
    """Samples as an observer takes them."""

    y: Array  # (n_samples, batch, q)
    u: Array  # (n_samples, batch, m)
    status: Bits  # (n_samples, batch)
    starts: Flags  # (n_samples, batch)
    unsure: Flags  # (n_samples, batch); An input is not known beside a measurement, or for more than a few samples
    complete: Flags  # (n_samples, batch); An observer may start at them
    held: Held


@frozen
class Screen:
    """Judges samples one by one; limits, and between which values a sample is plausible, of [y; u], (q + m,) each."""

    lower: Array
    upper: Array
    least: Array
    most: Array
    q: int
    longest: int = LONGEST
    persistence: float | Array = 1.0
    inputs_only: bool = False  # whether inputs are enough to start at, as for filter banks

    @classmethod
    def of(cls, observer: ObserverData) -> Screen:
        """Return the screen of an observer: its declared limits, and the sizes seen in training."""
        sides = (side[list(observer.measured)] for side in observer.runtime.sides(observer.lifting.n_states))
        screen = cls.sized(observer.seen, len(observer.measured), len(observer.inputs), *sides)
        if observer.bank is None:
            return screen
        return replace(screen, longest=NEVER - 1, inputs_only=True, persistence=observer.bank.persistence)

    @classmethod
    def sized(
        cls, seen: Seen | None, q: int, m: int, lower: float | Array = -np.inf, upper: float | Array = np.inf
    ) -> Screen:
        """Return the screen for sizes seen in training, and limits of measurements where these are declared."""
        size, low, high = (np.full(q + m, end) for end in (np.inf, -np.inf, np.inf))
        low[:q], high[:q] = lower, upper
        if seen is not None:
            size = np.concatenate([seen.measured, seen.inputs])
            size[size == 0] = np.inf
        sides = [np.where(np.isfinite(side), np.abs(side), size) for side in (low, high)]
        far = np.minimum(BEYOND * np.maximum(*sides), np.finfo(float).max)
        return cls(low, high, -far, far, q)

    def enough(self, known: Flags) -> Flags:
        """Return whether measurements that are known, (..., q), are enough to start at."""
        return np.asarray(known.any(axis=-1) | self.inputs_only)

    def take(self, y: Array, u: Array, held: Held | None = None) -> Screened:
        """Judge samples y (n_samples, batch, q) and u (n_samples, batch, m); `held` is known before the first."""
        before, z, q = Held.nothing(*u.shape[1:]) if held is None else held, np.array([*y.T, *u.T]).T, self.q
        plausible, finite = (z >= self.least) & (z <= self.most), np.isfinite(z)
        within = np.minimum(np.maximum(z, self.lower), self.upper)
        beyond = (finite & (~plausible | (within != z))).any(axis=-1)
        status = np.where(finite[..., :q].all(axis=-1), 0, np.uint8(SampleStatus.MISSING))
        status |= np.where(finite[..., q:].all(axis=-1), 0, np.uint8(SampleStatus.INVALID_INPUT))
        status |= np.where(beyond, np.uint8(SampleStatus.LIMIT), 0)
        good, count = plausible[..., q:], np.arange(1, len(u) + 1)[:, None, None]
        latest = np.maximum.accumulate(np.where(good, count, 0), axis=0)
        since = np.where(latest > 0, count - latest, count + before.since)
        last = np.take_along_axis(np.concatenate([before.inputs[None], within[..., q:]]), latest, axis=0)
        earlier, ago = (np.concatenate([b[None], v[:-1]]) for b, v in ((before.inputs, last), (before.since, since)))
        changes = (last - earlier) / (ago + 1) * (ago <= self.longest)
        slopes = np.take_along_axis(np.concatenate([before.slopes[None], changes]), latest, axis=0)
        lasting = sum_of_powers(self.persistence, np.minimum(since, self.longest))
        inputs = np.clip(last + slopes * lasting, self.least[q:], self.most[q:])
        lost = np.asarray((since > self.longest).any(axis=-1))
        complete = np.asarray(good.all(axis=-1) & self.enough(plausible[..., :q]))
        starts, stale = _starts(lost, complete, before.stale)
        y = np.where(plausible, within, np.nan)[..., :q]
        allowed = np.where(np.isfinite(y).any(axis=-1, keepdims=True), 0, LONGEST)
        unsure = np.asarray((since > allowed).any(axis=-1))
        return Screened(y, inputs, status, starts, unsure, complete, Held(last[-1], slopes[-1], since[-1], stale))


def sum_of_powers(base: float | Array, count: Index) -> Array:
    """Return ``base + base^2 + ...``, so many terms, for a base from 0 to 1."""
    less = np.less(base, 1)
    return np.where(less, base * (1 - base**count) / np.where(less, 1 - base, 1.0), count)


def screened(observer: ObserverData, y: ArrayLike, u: ArrayLike, held: Held | None = None) -> Screened:
    """Return a batch of samples as an observer takes them; `held` is known before the first."""
    y, u = numbers(observer, y, "measurements"), numbers(observer, u, "inputs")
    q, inputs = len(observer.measured), observer.inputs
    n_samples, batch = y.shape[:2] if y.ndim == 3 and len(y) else (1, 0)
    if (y.shape, u.shape) != ((n_samples, batch, q), (n_samples, batch, len(inputs))):
        raise DimensionError(
            f"Running observer {observer.name}: expected {q} measurements and the inputs {tuple(inputs)} on the last "
            f"axes of y and u, (n_samples, batch, .), with at least one sample, found shapes {y.shape} and {u.shape}."
        )
    return Screen.of(observer).take(y, u, held)


def numbers(observer: ObserverData, values: ArrayLike, what: str) -> Array:
    """Return samples as numbers, NaN for what is masked."""
    try:
        return as_numbers(values)
    except (TypeError, ValueError) as error:
        actual = f"found {shortened(repr(values))} ({error})"
        raise DataError(f"Running observer {observer.name}: {what} should be numbers, {actual}.") from error


def _starts(lost: Flags, complete: Flags, stale: Flags) -> tuple[Flags, Flags]:
    """Return the first complete samples after some input was lost, and whether one is due at the end."""
    count = np.arange(1, len(lost) + 1)[:, None]
    lost_at = np.maximum.accumulate(np.where(lost, count, np.where(stale, 0, -1)), axis=0)
    complete_at = np.maximum.accumulate(np.where(complete, count, -1), axis=0)
    before = np.concatenate([np.full((1, lost.shape[1]), -1), complete_at[:-1]])
    return complete & (lost_at > before), lost_at[-1] > complete_at[-1]
