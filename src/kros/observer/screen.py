"""Plausibility of samples: missing, wrong and implausible ones, judged alike for batches and for one machine.

A sample is judged by itself, before the observer sees it:

| what arrives | what the observer takes | status |
|---|---|---|
| a measurement that is missing or not finite | nothing: it corrects nothing | `MISSING` |
| an input that is not finite | the last good one; zero before the first | `INVALID_INPUT` |
| a sample beyond a declared limit | the limit | `LIMIT` |
| a sample beyond 1.5 times its range | as if it were missing, or not finite | `LIMIT` |

The range is the largest size seen in training, or that of the declared limits; without either a sample has none. An input with declared limits has
none either: however large a command is, the machine gets the limit. So nothing that is far from anything possible enters a state, linear or
lifted, and what is left of a fault is what the model misses while it lasts.

Observers start at a measurement. Where none has arrived yet, or no value of some input, the estimate is that from rest, and the observer starts
again at the first sample at which there are both. It does so, too, after an input was held for more than a few samples: what a held reference
does to an observer that watches tracking errors grows with every sample, and a start costs no more than a start. Parameters stay.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields
from functools import cached_property
from math import isfinite

import numpy as np
import numpy.typing as npt

from .data import ObserverData
from .runtime import Seen
from .samples import LONGEST, Bits, Flags, Held, SampleStatus, Screened, require_samples

Array = npt.NDArray[np.float64]
BEYOND = 1.5  # times the range: what is further away is implausible
_ANY = np.finfo(float).max


@dataclass(frozen=True, eq=False)
class Bounds:
    """Limits of some channels, and between which values a sample is plausible; all of shape (channels,)."""

    lower: Array
    upper: Array
    least: Array
    most: Array

    @classmethod
    def of_measurements(
        cls, count: int, lower: Array | None = None, upper: Array | None = None, seen: Array | None = None
    ) -> Bounds:
        """Return the bounds that follow from declared limits of the states and sizes seen in training, where there are any."""
        low, high, size = _declared(count, lower, upper, seen)
        far = BEYOND * np.maximum(
            np.where(np.isfinite(low), np.abs(low), size), np.where(np.isfinite(high), np.abs(high), size)
        )
        return cls(low, high, -np.minimum(far, _ANY), np.minimum(far, _ANY))

    @classmethod
    def of_inputs(
        cls, count: int, lower: Array | None = None, upper: Array | None = None, seen: Array | None = None
    ) -> Bounds:
        """Return those of inputs, which are plausible beyond a declared limit: the machine gets the limit."""
        low, high, size = _declared(count, lower, upper, seen)
        far = np.minimum(BEYOND * size, _ANY)
        return cls(low, high, np.where(np.isfinite(low), -_ANY, -far), np.where(np.isfinite(high), _ANY, far))

    def pass_all(self, values: Array) -> bool:
        """Whether all samples, shape (..., channels), are good as they are."""
        channels = ((values[..., i], *sides) for i, sides in enumerate(self.good))
        return all(
            bool(least <= own.min(initial=least) and own.max(initial=most) <= most) for own, least, most in channels
        )

    @cached_property
    def good(self) -> list[tuple[float, float]]:
        """Between which values a sample of every channel is good as it is."""
        return list(
            zip(np.maximum(self.lower, self.least).tolist(), np.minimum(self.upper, self.most).tolist(), strict=True)
        )

    def pass_one(self, values: Sequence[float]) -> bool:
        """Whether one sample is good as it is, as `pass_all` for many: a comparison with what is not a number is false."""
        return all(least <= value <= most for value, (least, most) in zip(values, self.good, strict=True))

    def pass_where_there(self, values: Sequence[float]) -> bool:
        """Whether one sample is good but for channels that are missing."""
        return all(
            least <= value <= most or not isfinite(value)
            for value, (least, most) in zip(values, self.good, strict=True)
        )

    def judge(self, values: Array) -> tuple[Array, Flags, Flags]:
        """Return samples within their limits, which of them are plausible, and which are beyond a limit or their range."""
        plausible = (values >= self.least) & (values <= self.most)
        kept = np.clip(values, self.lower, self.upper)
        return kept, plausible, np.isfinite(values) & (~plausible | (kept != values))


def _declared(count: int, lower: Array | None, upper: Array | None, seen: Array | None) -> tuple[Array, Array, Array]:
    low, high = (
        np.full(count, side) if given is None else given for side, given in ((-np.inf, lower), (np.inf, upper))
    )
    return low, high, np.full(count, np.inf) if seen is None else np.where(seen > 0, seen, np.inf)


@dataclass(frozen=True, eq=False)
class Screen:
    """Judges samples one by one."""

    measured: Bounds
    inputs: Bounds

    def same_as(self, other: Screen) -> bool:
        """Whether two screens judge alike."""
        pairs = ((self.measured, other.measured), (self.inputs, other.inputs))
        return all(np.array_equal(getattr(a, f.name), getattr(b, f.name)) for a, b in pairs for f in fields(Bounds))

    @classmethod
    def of(cls, observer: ObserverData) -> Screen:
        """Return the screen of an observer: its declared limits, and the sizes seen in training."""
        at, limits, seen = list(observer.measured), observer.runtime, observer.seen
        lower, upper = (None if side is None else side[at] for side in (limits.lower, limits.upper))
        sizes = (None, None) if seen is None else (seen.measured, seen.inputs)
        measured = Bounds.of_measurements(len(at), lower, upper, sizes[0])
        return cls(measured, Bounds.of_inputs(len(observer.inputs), limits.input_lower, limits.input_upper, sizes[1]))

    @classmethod
    def sized(cls, seen: Seen | None, q: int, m: int) -> Screen:
        """Return the screen of an estimator that declares no limits."""
        sizes = (None, None) if seen is None else (seen.measured, seen.inputs)
        return cls(Bounds.of_measurements(q, seen=sizes[0]), Bounds.of_inputs(m, seen=sizes[1]))

    def at_once(self, y: Sequence[float], u: Sequence[float]) -> SampleStatus | None:
        """Return the status of one sample that is taken as it is, good or without some measurements; None for one that `take` has to judge."""
        if not self.inputs.pass_one(u):
            return None
        if self.measured.pass_one(y):
            return SampleStatus.GOOD
        return SampleStatus.MISSING if self.measured.pass_where_there(y) else None

    def take(self, y: Array, u: Array, held: Held | None = None) -> Screened:
        """Judge samples y (n_samples, batch, q) and u (n_samples, batch, m) in the order in which they arrive; `held` is known before the first."""
        before = Held.nothing(*u.shape[1:]) if held is None else held
        if self.measured.pass_all(y) and self.inputs.pass_all(u):
            return _as_they_are(y, u, before)
        kept, plausible, beyond = self.measured.judge(y)
        limited, good, far = self.inputs.judge(u)
        status = _bit(~np.isfinite(y), SampleStatus.MISSING) | _bit(~np.isfinite(u), SampleStatus.INVALID_INPUT)
        status |= _bit(beyond, SampleStatus.LIMIT) | _bit(far, SampleStatus.LIMIT)
        count = np.arange(1, len(u) + 1)[:, None, None]
        latest = np.maximum.accumulate(np.where(good, count, 0), axis=0)
        since = np.where(latest > 0, count - latest, count + before.since)
        inputs = np.take_along_axis(np.concatenate([before.inputs[None], limited]), latest, axis=0)
        lost, complete = (
            np.asarray((since > LONGEST).any(axis=-1)),
            np.asarray(good.all(axis=-1) & plausible.any(axis=-1)),
        )
        starts, stale = _starts(lost, complete, before.stale)
        return Screened(
            np.where(plausible, kept, np.nan), inputs, status, starts, complete, Held(inputs[-1], since[-1], stale)
        )


def sample_status(observer: ObserverData, y: Array, u: Array) -> Bits:
    """Return the bits of `SampleStatus` that samples have by themselves, shape (n_samples, batch); `run_with_status` adds those of the observer.

    Examples
    --------
    >>> import numpy as np
    >>> from kros.lifting import Lifting
    >>> from kros.observer import Observer, SampleStatus, sample_status
    >>> observer = Observer.open_loop("lag", Lifting(("x",)), np.array([[0.5]]), np.ones((1, 1)), (0,), ("u",), 0.01)
    >>> y = np.array([1.0, np.nan, 0.5]).reshape(3, 1, 1)
    >>> [SampleStatus(int(bits)).name for bits in sample_status(observer, y, np.zeros((3, 1, 1))).ravel()]
    ['GOOD', 'MISSING', 'GOOD']
    """
    return screened(observer, y, u).status


def screened(observer: ObserverData, y: npt.ArrayLike, u: npt.ArrayLike) -> Screened:
    """Return a batch of samples as an observer takes them."""
    y, u = np.asarray(y, dtype=float), np.asarray(u, dtype=float)
    require_samples(f"observer {observer.name}", len(observer.measured), observer.inputs, y, u)
    return Screen.of(observer).take(y, u)


def _bit(wrong: Flags, bit: SampleStatus) -> Bits:
    return np.where(wrong.any(axis=-1), np.uint8(bit), np.uint8(0))


def _as_they_are(y: Array, u: Array, before: Held) -> Screened:
    starts = np.zeros(y.shape[:2], dtype=bool)
    starts[0] = before.stale
    return Screened(y, u, np.zeros(y.shape[:2], np.uint8), starts, np.ones(y.shape[:2], dtype=bool), Held.good(u[-1]))


def _starts(lost: Flags, complete: Flags, stale: Flags) -> tuple[Flags, Flags]:
    """Return the complete samples, shape (n_samples, batch), that are the first ones after some input was lost, and whether one is due at the end."""
    count = np.arange(1, len(lost) + 1)[:, None]
    lost_at = np.maximum.accumulate(np.where(lost, count, np.where(stale, 0, -1)), axis=0)
    complete_at = np.maximum.accumulate(np.where(complete, count, -1), axis=0)
    before = np.concatenate([np.full((1, lost.shape[1]), -1), complete_at[:-1]])
    return complete & (lost_at > before), lost_at[-1] > complete_at[-1]
