"""What an observer believes of what arrives: missing, wrong and implausible samples, the same for batches and for one machine.

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
anew at the first sample at which there are both. It does so, too, after an input was held for more than a few samples: what a held reference
does to an observer that watches tracking errors grows with every sample, and a start costs no more than a start. Parameters stay.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from enum import IntFlag
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from ..core.errors import DataError, DimensionError

if TYPE_CHECKING:
    from .observer import Observer

Array = npt.NDArray[np.float64]
Bits = npt.NDArray[np.uint8]
Whole = npt.NDArray[np.intp]
Flags = npt.NDArray[np.bool_]
BEYOND = 1.5  # times the range: what is further away is not believed
LONGEST = 5  # samples for which an input may be held without a new start
_ANY = np.finfo(float).max


class SampleStatus(IntFlag):
    """What was wrong with a sample; bits add up.

    GOOD
        Nothing.
    MISSING
        A measurement is missing or not finite. It corrected nothing.
    INVALID_INPUT
        An input is not finite. The last good value stood for it.
    LIMIT
        A sample is beyond its limit or 1.5 times its range, or the estimate or the correction met a limit that is declared.
    UNCERTIFIED
        Outside what the observer is certified for. Reserved: never set in this version.
    """

    GOOD = 0
    MISSING = 1
    INVALID_INPUT = 2
    LIMIT = 4
    UNCERTIFIED = 8


@dataclass(frozen=True, eq=False)
class Seen:
    """The largest sizes seen in training.

    Parameters
    ----------
    measured : ndarray, shape (q,)
        Largest absolute value of every measurement; a channel that was always zero has no range.
    inputs : ndarray, shape (m,)
        Of every recorded input.

    Raises
    ------
    DataError
        When a size is negative or not finite.
    """

    measured: Array
    inputs: Array

    def __post_init__(self) -> None:
        for name in ("measured", "inputs"):
            values = np.atleast_1d(np.asarray(getattr(self, name), dtype=float))
            object.__setattr__(self, name, values)
            if values.ndim != 1 or not np.isfinite(values).all() or np.any(values < 0):
                raise DataError(f"Sizes seen in training: {name} should be one finite size of at least 0 a channel, found {values}.")

    @classmethod
    def from_content(cls, content: Mapping[str, Any] | None) -> Seen | None:
        """Read what an observer's file holds; None where it holds nothing."""
        return None if content is None else cls(content["measured"], content["inputs"])


@dataclass(frozen=True, eq=False)
class Bounds:
    """Limits of some channels, and between which values a sample is believed; all of shape (channels,)."""

    lower: Array
    upper: Array
    least: Array
    most: Array

    @classmethod
    def of_measurements(cls, count: int, lower: Array | None = None, upper: Array | None = None, seen: Array | None = None) -> Bounds:
        """Return the bounds that follow from declared limits of the states and sizes seen in training, where there are any."""
        low, high, size = _declared(count, lower, upper, seen)
        far = BEYOND * np.maximum(np.where(np.isfinite(low), np.abs(low), size), np.where(np.isfinite(high), np.abs(high), size))
        return cls(low, high, -np.minimum(far, _ANY), np.minimum(far, _ANY))

    @classmethod
    def of_inputs(cls, count: int, lower: Array | None = None, upper: Array | None = None, seen: Array | None = None) -> Bounds:
        """Return those of inputs, which are believed beyond a declared limit: the machine gets the limit."""
        low, high, size = _declared(count, lower, upper, seen)
        far = np.minimum(BEYOND * size, _ANY)
        return cls(low, high, np.where(np.isfinite(low), -_ANY, -far), np.where(np.isfinite(high), _ANY, far))

    def pass_all(self, values: Array) -> bool:
        """Whether all samples, shape (..., channels), are good as they are."""
        return bool(np.all((values >= np.maximum(self.lower, self.least)) & (values <= np.minimum(self.upper, self.most))))

    def judge(self, values: Array) -> tuple[Array, Flags, Flags]:
        """Return samples within their limits, which of them are believed, and which are beyond a limit or their range."""
        believed = (values >= self.least) & (values <= self.most)
        kept = np.clip(values, self.lower, self.upper)
        return kept, believed, np.isfinite(values) & (~believed | (kept != values))


def _declared(count: int, lower: Array | None, upper: Array | None, seen: Array | None) -> tuple[Array, Array, Array]:
    low, high = (np.full(count, side) if given is None else given for side, given in ((-np.inf, lower), (np.inf, upper)))
    return low, high, np.full(count, np.inf) if seen is None else np.where(seen > 0, seen, np.inf)


@dataclass(frozen=True, eq=False)
class Held:
    """What is remembered from sample to sample.

    Parameters
    ----------
    inputs : ndarray, shape (batch, m)
        Last good ones; zero before the first.
    since : ndarray of int, shape (batch, m)
        Samples since then.
    stale : ndarray of bool, shape (batch,)
        Whether the observer starts anew at the next sample with a measurement and all inputs.
    """

    inputs: Array
    since: Whole
    stale: Flags

    @classmethod
    def nothing(cls, batch: int, m: int) -> Held:
        """Return what is known before the first sample."""
        return cls(np.zeros((batch, m)), np.full((batch, m), LONGEST + 1), np.ones(batch, dtype=bool))


@dataclass(frozen=True, eq=False)
class Screened:
    """Samples as an observer takes them.

    Parameters
    ----------
    y : ndarray, shape (n_samples, batch, q)
        NaN where a measurement corrects nothing.
    u : ndarray, shape (n_samples, batch, m)
        Finite.
    status : ndarray of uint8, shape (n_samples, batch)
        Bits of `SampleStatus`.
    starts : ndarray of bool, shape (n_samples, batch)
        Samples at which an observer starts anew.
    held : Held
        After the last sample.
    """

    y: Array
    u: Array
    status: Bits
    starts: Flags
    held: Held

    def of(self, members: Sequence[int]) -> Screened:
        """Return the samples of some members of the batch."""
        held = Held(self.held.inputs[members], self.held.since[members], self.held.stale[members])
        return Screened(self.y[:, members], self.u[:, members], self.status[:, members], self.starts[:, members], held)


@dataclass(frozen=True, eq=False)
class Screen:
    """Judges samples one by one."""

    measured: Bounds
    inputs: Bounds

    @classmethod
    def of(cls, observer: Observer) -> Screen:
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

    def take(self, y: Array, u: Array, held: Held | None = None) -> Screened:
        """Judge samples in the order in which they arrive.

        Parameters
        ----------
        y : ndarray, shape (n_samples, batch, q)
        u : ndarray, shape (n_samples, batch, m)
        held : Held, optional
            What is known before the first sample; nothing by default.
        """
        before = Held.nothing(*u.shape[1:]) if held is None else held
        if self.measured.pass_all(y) and self.inputs.pass_all(u):
            return _as_they_are(y, u, before)
        kept, believed, beyond = self.measured.judge(y)
        limited, good, far = self.inputs.judge(u)
        status = _bit(~np.isfinite(y), SampleStatus.MISSING) | _bit(~np.isfinite(u), SampleStatus.INVALID_INPUT)
        status |= _bit(beyond, SampleStatus.LIMIT) | _bit(far, SampleStatus.LIMIT)
        count = np.arange(1, len(u) + 1)[:, None, None]
        latest = np.maximum.accumulate(np.where(good, count, 0), axis=0)
        since = np.where(latest > 0, count - latest, count + before.since)
        inputs = np.take_along_axis(np.concatenate([before.inputs[None], limited]), latest, axis=0)
        lost, complete = np.asarray((since > LONGEST).any(axis=-1)), np.asarray(good.all(axis=-1) & believed.any(axis=-1))
        starts, stale = _starts(lost, complete, before.stale)
        return Screened(np.where(believed, kept, np.nan), inputs, status, starts, Held(inputs[-1], since[-1], stale))


def sample_status(observer: Observer, y: Array, u: Array) -> Bits:
    """Return the bits of `SampleStatus` of every sample, shape (n_samples, batch), as the observer takes them in a batch.

    Parameters
    ----------
    observer : Observer
    y : ndarray, shape (n_samples, batch, q)
    u : ndarray, shape (n_samples, batch, m)
    """
    return Screen.of(observer).take(np.asarray(y, dtype=float), np.asarray(u, dtype=float)).status


def started_anew(
    run: Callable[[Array, Array, Mapping[str, Any]], tuple[Array, ...]],
    samples: Screened,
    parameters: Mapping[str, npt.ArrayLike] | None,
    carried: Callable[[tuple[Array, ...], int, Whole], Mapping[str, Array]] | None = None,
) -> tuple[Array, ...]:
    """Run a batch, and every member once more from each sample at which it starts anew to the next.

    Parameters
    ----------
    run : callable
        From measurements, inputs and parameters to arrays of shape (n_samples, batch, ...), row 0 being the start.
    samples : Screened
    parameters : mapping of str to array_like, shape (batch,)
    carried : callable, optional
        From what was found so far, a sample and members to parameters that a new start goes on with.
    """
    values, (n_samples, batch) = dict(parameters or {}), samples.starts.shape
    found = run(samples.y, samples.u, values)
    for begin in np.flatnonzero(samples.starts[1:].any(axis=1)) + 1:
        own = np.flatnonzero(samples.starts[begin])
        again = samples.starts[begin + 1 :, own]
        lasts = np.where(again.any(axis=0), begin + 1 + again.argmax(axis=0), n_samples - 1) if len(again) else begin
        rows = slice(begin, int(np.max(lasts)) + 1)
        part = {name: np.broadcast_to(np.asarray(v, dtype=float), (batch,))[own] for name, v in values.items()}
        part |= carried(found, int(begin), own) if carried is not None else {}
        late = run(samples.y[rows, own], samples.u[rows, own], part)
        for whole, rest in zip(found, late, strict=True):
            whole[begin + 1 : rows.stop, own] = rest[1:]
    return found


def require_samples(who: str, measured: int, inputs: tuple[str, ...], y: Array, u: Array) -> None:
    """Refuse measurements and inputs that do not fit together, or to an observer."""
    if y.ndim != 3 or u.ndim != 3 or y.shape[:2] != u.shape[:2] or not len(y):
        raise DimensionError(
            f"Running {who}: measurements {y.shape} and inputs {u.shape} should agree in (n_samples, batch), with a last axis for their channels and at "
            "least one sample."
        )
    if u.shape[2] != len(inputs):
        raise DimensionError(f"Running {who}: expected inputs {tuple(inputs)} on the last axis of u, found shape {u.shape}.")
    if y.shape[2] != measured:
        raise DimensionError(f"Running {who}: expected {measured} measurements on the last axis of y, found shape {y.shape}.")


def _bit(wrong: Flags, bit: SampleStatus) -> Bits:
    return np.where(wrong.any(axis=-1), np.uint8(bit), np.uint8(0))


def _as_they_are(y: Array, u: Array, before: Held) -> Screened:
    starts = np.zeros(y.shape[:2], dtype=bool)
    starts[0] = before.stale
    after = Held(u[-1], np.zeros(u.shape[1:], dtype=int), np.zeros(y.shape[1], dtype=bool))
    return Screened(y, u, np.zeros(y.shape[:2], np.uint8), starts, after)


def _starts(lost: Flags, complete: Flags, stale: Flags) -> tuple[Flags, Flags]:
    """Return the complete samples, shape (n_samples, batch), that are the first ones after some input was lost, and whether one is due at the end."""
    count = np.arange(1, len(lost) + 1)[:, None]
    lost_at = np.maximum.accumulate(np.where(lost, count, np.where(stale, 0, -1)), axis=0)
    complete_at = np.maximum.accumulate(np.where(complete, count, -1), axis=0)
    before = np.concatenate([np.full((1, lost.shape[1]), -1), complete_at[:-1]])
    return complete & (lost_at > before), lost_at[-1] > complete_at[-1]
