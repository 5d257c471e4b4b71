"""What an observer believes of what arrives: missing, wrong and implausible samples, the same for batches and for one machine.

A sample is judged by itself, before the observer sees it:

| what arrives | what the observer takes | status |
|---|---|---|
| a measurement that is missing or not finite | nothing: it corrects nothing | `MISSING` |
| an input that is not finite | the last good one; zero before the first | `INVALID_INPUT` |
| a sample beyond a declared limit | the limit | `LIMIT` |
| a sample beyond 1.5 times its range | as if it were missing, or not finite | `LIMIT` |

The range is the declared limits', else the largest size seen in training; without either a sample has none. So nothing that is far from
anything possible enters a state, linear or lifted, and what is left of a fault is what the model misses while it lasts.

Observers start at a measurement. Where none has arrived yet, or no value of some input, the estimate is that from rest, and the observer starts
anew at the first sample at which there are both.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
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
BEYOND = 1.5  # times the range: what is further away is not believed
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
    """Limits of some channels, and how far a sample is believed; all of shape (channels,)."""

    lower: Array
    upper: Array
    believed: Array

    @classmethod
    def of(cls, count: int, lower: Array | None = None, upper: Array | None = None, seen: Array | None = None) -> Bounds:
        """Return the bounds that follow from declared limits and sizes seen in training, where there are any."""
        low, high = (np.full(count, side) if given is None else given for side, given in ((-np.inf, lower), (np.inf, upper)))
        size = np.full(count, np.inf) if seen is None else np.where(seen > 0, seen, np.inf)
        range_ = np.maximum(np.where(np.isfinite(low), np.abs(low), size), np.where(np.isfinite(high), np.abs(high), size))
        return cls(low, high, np.minimum(BEYOND * range_, _ANY))

    def pass_all(self, values: Array) -> bool:
        """Whether all samples, shape (..., channels), are good as they are."""
        low, high = np.maximum(self.lower, -self.believed), np.minimum(self.upper, self.believed)
        return bool(np.all((values >= low) & (values <= high)))

    def judge(self, values: Array) -> tuple[Array, npt.NDArray[np.bool_], npt.NDArray[np.bool_]]:
        """Return samples within their limits, which of them are believed, and which are beyond a limit or their range."""
        believed = np.abs(values) <= self.believed
        kept = np.clip(values, self.lower, self.upper)
        return kept, believed, np.isfinite(values) & (~believed | (kept != values))


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
    known : ndarray of bool, shape (n_samples, batch)
        Whether every input has had a good value by then.
    """

    y: Array
    u: Array
    status: Bits
    known: npt.NDArray[np.bool_]

    @property
    def begins(self) -> Whole:
        """First sample at which there are a measurement and all inputs, shape (batch,); 0 where there is none."""
        return np.argmax(np.isfinite(self.y).any(axis=-1) & self.known, axis=0)


@dataclass(frozen=True, eq=False)
class Screen:
    """Judges samples one by one; nothing is remembered but the last good inputs."""

    measured: Bounds
    inputs: Bounds

    @classmethod
    def of(cls, observer: Observer) -> Screen:
        """Return the screen of an observer: its declared limits, and the sizes seen in training."""
        at, limits, seen = list(observer.measured), observer.runtime, observer.seen
        lower, upper = (None if side is None else side[at] for side in (limits.lower, limits.upper))
        measured = Bounds.of(len(at), lower, upper, None if seen is None else seen.measured)
        return cls(measured, Bounds.of(len(observer.inputs), limits.input_lower, limits.input_upper, None if seen is None else seen.inputs))

    @classmethod
    def sized(cls, seen: Seen | None, q: int, m: int) -> Screen:
        """Return the screen of an estimator that declares no limits."""
        sizes = (None, None) if seen is None else (seen.measured, seen.inputs)
        return cls(Bounds.of(q, seen=sizes[0]), Bounds.of(m, seen=sizes[1]))

    def take(self, y: Array, u: Array, last: Array | None = None, known: npt.NDArray[np.bool_] | None = None) -> Screened:
        """Judge samples in the order in which they arrive.

        Parameters
        ----------
        y : ndarray, shape (n_samples, batch, q)
        u : ndarray, shape (n_samples, batch, m)
        last : ndarray, shape (batch, m), optional
            Inputs before the first sample; zero by default.
        known : ndarray of bool, shape (batch, m), optional
            Which of them were measured; none by default.
        """
        shape = y.shape[:2]
        if self.measured.pass_all(y) and self.inputs.pass_all(u):
            return Screened(y, u, np.zeros(shape, np.uint8), np.ones(shape, dtype=bool))
        kept, believed, beyond = self.measured.judge(y)
        held, good, far = self.inputs.judge(u)
        status = _bit(~np.isfinite(y), SampleStatus.MISSING) | _bit(~np.isfinite(u), SampleStatus.INVALID_INPUT)
        status |= _bit(beyond, SampleStatus.LIMIT) | _bit(far, SampleStatus.LIMIT)
        first = np.zeros(u.shape[1:]) if last is None else last
        count = np.arange(1, len(u) + 1)[:, None, None]
        latest = np.maximum.accumulate(np.where(good, count, 0), axis=0)
        inputs = np.take_along_axis(np.concatenate([first[None], held]), latest, axis=0)
        before = np.zeros(u.shape[1:], dtype=bool) if known is None else known
        return Screened(np.where(believed, kept, np.nan), inputs, status, np.all((latest > 0) | before, axis=-1))


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
    run: Callable[[Array, Array, Mapping[str, Any]], tuple[Array, ...]], samples: Screened, parameters: Mapping[str, npt.ArrayLike] | None
) -> tuple[Array, ...]:
    """Run a batch, and members without a first measurement or input once more from where they have both.

    Parameters
    ----------
    run : callable
        From measurements, inputs and parameters to arrays of shape (n_samples, batch, ...), row 0 being the start.
    samples : Screened
    parameters : mapping of str to array_like, shape (batch,)
    """
    values = dict(parameters or {})
    found = run(samples.y, samples.u, values)
    begins, batch = samples.begins, samples.y.shape[1]
    for begin in np.unique(begins[begins > 0]):
        own = np.flatnonzero(begins == begin)
        part = {name: np.broadcast_to(np.asarray(v, dtype=float), (batch,))[own] for name, v in values.items()}
        late = run(samples.y[begin:, own], samples.u[begin:, own], part)
        for whole, rest in zip(found, late, strict=True):
            whole[begin + 1 :, own] = rest[1:]
    return found


def require_samples(who: str, measured: int, inputs: tuple[str, ...], y: Array, u: Array) -> None:
    """Refuse measurements and inputs that do not fit together, or to an observer."""
    if y.ndim != 3 or u.ndim != 3 or y.shape[:2] != u.shape[:2] or not len(y):
        raise DimensionError(
            f"Running {who}: measurements {y.shape} and inputs {u.shape} should agree in (n_samples, batch), with a last axis for their channels and at "
            "least one sample."
        )
    if u.shape[2] != len(inputs):
        raise DimensionError(f"Running {who}: expected the {len(inputs)} inputs {tuple(inputs)} on the last axis of u, found shape {u.shape}.")
    if y.shape[2] != measured:
        raise DimensionError(f"Running {who}: expected {measured} measurements on the last axis of y, found shape {y.shape}.")


def _bit(wrong: npt.NDArray[np.bool_], bit: SampleStatus) -> Bits:
    return np.where(wrong.any(axis=-1), np.uint8(bit), np.uint8(0))
