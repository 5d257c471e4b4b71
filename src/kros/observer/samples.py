"""Samples of measurements and inputs as an observer takes them, with what was wrong with each."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from enum import IntFlag

import numpy as np
import numpy.typing as npt

from ..core.errors import DimensionError

Array = npt.NDArray[np.float64]
Bits = npt.NDArray[np.uint8]
Whole = npt.NDArray[np.intp]
Flags = npt.NDArray[np.bool_]
LONGEST = 5  # samples for which an input may be held without a new start


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
        Outside what the observer is certified for: the innovation is beyond the envelope of the population (see `monitor`).
    RESTARTED
        The estimate left its bounds, as it may while samples are lost: the observer waits for a good sample to start at, or that start has not settled yet.

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


@dataclass(frozen=True, eq=False)
class Held:
    """Inputs held from sample to sample."""

    inputs: Array  # (batch, m)
    since: Whole  # (batch, m)
    stale: Flags  # (batch,)

    @classmethod
    def nothing(cls, batch: int, m: int) -> Held:
        """Return what is known before the first sample."""
        return cls(np.zeros((batch, m)), np.full((batch, m), LONGEST + 1), np.ones(batch, dtype=bool))

    @classmethod
    def good(cls, inputs: Array) -> Held:
        """Return what is known after good samples, inputs of shape (batch, m) the last ones."""
        return cls(inputs, np.zeros(inputs.shape, dtype=int), np.zeros(len(inputs), dtype=bool))


@dataclass(frozen=True, eq=False)
class Screened:
    """Samples as an observer takes them."""

    y: Array  # (n_samples, batch, q)
    u: Array  # (n_samples, batch, m)
    status: Bits  # (n_samples, batch)
    starts: Flags  # (n_samples, batch)
    complete: Flags  # (n_samples, batch); An observer may start at them
    held: Held

    def of(self, members: Sequence[int] | Whole) -> Screened:
        """Return the samples of some members of the batch."""
        held = Held(self.held.inputs[members], self.held.since[members], self.held.stale[members])
        y, u, at = self.y[:, members], self.u[:, members], (slice(None), members)
        return Screened(y, u, self.status[at], self.starts[at], self.complete[at], held)


def require_samples(who: str, measured: int, inputs: tuple[str, ...], y: Array, u: Array) -> None:
    """Refuse measurements and inputs that do not fit together, or to an observer."""
    if y.ndim != 3 or u.ndim != 3 or y.shape[:2] != u.shape[:2] or not len(y):
        raise DimensionError(
            f"Running {who}: measurements {y.shape} and inputs {u.shape} should agree in (n_samples, batch), with a last axis for their channels and at "
            "least one sample."
        )
    if u.shape[2] != len(inputs):
        raise DimensionError(
            f"Running {who}: expected inputs {tuple(inputs)} on the last axis of u, found shape {u.shape}."
        )
    if y.shape[2] != measured:
        raise DimensionError(
            f"Running {who}: expected {measured} measurements on the last axis of y, found shape {y.shape}."
        )
