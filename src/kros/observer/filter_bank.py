r"""What makes an observer a filter bank: how it starts, and what stands for measurements that are missing.

While measurements arrive, a filter bank feeds nothing back that it estimates. Behind the recorded states x its internal
states are the filters z of measurements and inputs, whose estimate is given then, and the filters w of inputs alone with
their own estimate :math:`x^u` of all recorded states. The fallback

.. math:: f_{k+1} = x^u_{k+1} + o_{k+1}, \qquad o_{k+1} = \rho \, (x_k - x^u_k),

continues the last estimate (of measured states: the last measurement) and tends to :math:`x^u`. The age a of a gap is the number of samples that are
missing so far; when measurements return it falls by a factor :math:`\mu` a sample, as the filters forget what stood for them. With the level
:math:`m = a / (a + T)` the estimate changes over from z to the fallback by shares :math:`\beta(m)` that training chose. A missing measurement is
replaced by its estimate, at most :math:`1 - m` times a reach away from the fallback: what the filters see is bounded for any pattern of losses, and so
are they. When a measurement returns, the gap is bridged by a straight line: the response r of the filters to a unit ramp was run along, and ``z`` is
corrected by :math:`r (y - \hat y) / (g + 1)` after g samples.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import numpy.typing as npt

from ..core.errors import DataError, DimensionError

Array = npt.NDArray[np.float64]
_ARRAYS = ("start", "forget", "levels", "shares", "reach")


@dataclass(frozen=True, eq=False)
class FilterBank:
    """Start and gaps of an observer that is a filter bank.

    Parameters
    ----------
    filters : int
        Number of filters z, the first internal states; those of inputs alone follow, and the estimates of these, one for every recorded state.
    start : ndarray, shape (n_states, n_lifted + inputs)
        First estimate from the lifted first sample: ``start @ [theta(y_0); u_0; gamma(u_0, y_0)]``, states that are not measured taken as zero.
    forget : ndarray, shape (n,)
        rho of every recorded state, between zero and one.
    half : float
        T, the age of a gap at which its level is one half, in samples.
    recovery : float
        mu, between zero and one.
    levels : ndarray, shape (k,)
        Levels m, increasing from zero to one.
    shares : ndarray, shape (k, n)
        beta at these levels, between zero and one; on straight lines between them.
    reach : ndarray, shape (q,)
        Largest distance between what stands for a missing measurement and the fallback, at level zero.

    Raises
    ------
    DataError
        When a number is not finite or outside its range.

    Examples
    --------
    >>> import numpy as np
    >>> from kros.observer import FilterBank
    >>> levels, shares = np.array([0.0, 0.5, 1.0]), np.array([[0.0], [0.2], [1.0]])
    >>> bank = FilterBank(1, np.zeros((3, 5)), np.array([0.99]), 30.0, 0.97, levels, shares, np.array([0.1]))
    >>> bank.share(np.array([0.75])).round(3).tolist()
    [[0.6]]
    """

    filters: int
    start: Array
    forget: Array
    half: float
    recovery: float
    levels: Array
    shares: Array
    reach: Array

    def __post_init__(self) -> None:
        for name in _ARRAYS:
            object.__setattr__(self, name, np.asarray(getattr(self, name), dtype=float))
        shares = [self.forget, self.shares, self.levels, np.array(self.recovery)]
        if not (
            np.isfinite(self.start).all()
            and np.isfinite(self.reach).all()
            and (self.reach >= 0).all()
            and self.half > 0
        ) or not all(((v >= 0) & (v <= 1)).all() for v in shares):
            raise DataError(
                f"Filter bank: start and reach should be finite, and forget {self.forget}, recovery {self.recovery}, levels and shares between 0 and 1."
            )
        if not (len(self.levels) == len(self.shares) and (np.diff(self.levels) > 0).all()):
            raise DataError(f"Filter bank: levels {self.levels} should increase, with shares for each.")

    def require_fit(self, name: str, recorded: int, n: int, columns: int, measured: int) -> None:
        """Refuse arrays of another size than the observer's."""
        sizes = (self.start.shape, self.forget.shape, self.shares.shape[1:], self.reach.shape)
        if sizes != ((n, columns), (recorded,), (recorded,), (measured,)) or not 0 <= self.filters <= n - 2 * recorded:
            raise DimensionError(
                f"Observer {name}: its filter bank should have a start {(n, columns)}, {recorded} values of forget and shares "
                f"and {measured} of reach, found {sizes}, and "
                f"at most {n - 2 * recorded} filters, found {self.filters}."
            )

    def share(self, level: Array) -> Array:
        """Return beta, shape (..., n), at levels."""
        at = np.clip(np.searchsorted(self.levels, level, side="right") - 1, 0, len(self.levels) - 2)
        part = (level - self.levels[at]) / (self.levels[at + 1] - self.levels[at])
        return np.asarray(self.shares[at] + part[..., None] * (self.shares[at + 1] - self.shares[at]))

    def times(self, x: Array, columns: Array, y: Array) -> FilterBank:
        """Return the bank in other units of measure, by the factors of all states, of the columns of `start` and of measurements."""
        return replace(self, start=self.start * x[:, None] / columns, reach=self.reach * y)

    def turned(self, turn: Array) -> FilterBank:
        """Return the bank for states ``turn @ x``, shape (n, n), which leaves recorded states and fallback alone."""
        return replace(self, start=turn @ self.start)

    def content(self) -> dict[str, Any]:
        """Return what an observer's file holds of it."""
        return {name: getattr(self, name).tolist() for name in _ARRAYS} | {
            "filters": self.filters,
            "half": self.half,
            "recovery": self.recovery,
        }

    @classmethod
    def from_content(cls, content: Mapping[str, Any]) -> FilterBank:
        """Read what `content` returned."""
        return cls(**content)


class Gaps:
    """State of the gaps of filter banks over a batch of machines."""

    def __init__(self, bank: FilterBank, A: Array, measured: tuple[int, ...], recorded: int, batch: int) -> None:
        n, q, first = len(A), len(measured), recorded
        self.bank, self.measured, self.recorded = bank, list(measured), recorded
        self.filters = slice(first, first + bank.filters)
        self.fallback = slice(n - recorded, n)
        self._A, self._B = A[self.filters, self.filters], A[self.filters, :][:, self.measured]
        self.offset, self.age = np.zeros((batch, recorded)), np.zeros(batch)
        self.held = np.zeros((batch, q))  # the fallback of measurements
        self.filtered = self.expected = np.zeros((batch, recorded))  # by filters and by the fallback, after a step
        self.ramp, self.count = np.zeros((batch, bank.filters, q)), np.zeros((batch, q))

    def begin(self, rows: Any) -> None:
        """Start some machines: nothing is missing."""
        for values in (self.offset, self.age, self.ramp, self.count):
            values[rows] = 0.0

    @property
    def level(self) -> Array:
        """Level of the gap of every machine, shape (batch,)."""
        return np.asarray(self.age / (self.age + self.bank.half))

    def fill(self, x: Array, y: Array, missing: npt.NDArray[np.bool_]) -> None:
        """Put measurements (batch, q) and what stands for missing ones into states (batch, n), and bridge gaps that end."""
        self.held = (x[:, self.fallback] + self.offset)[:, self.measured]
        reach = (1 - self.level[:, None]) * self.bank.reach
        near = np.clip(x[:, self.measured] - self.held, -reach, reach)
        expected = self.held + near
        ends = ~missing & (self.count > 0)
        if ends.any():
            jump = np.where(ends, (np.where(missing, 0.0, y) - expected) / (self.count + 1), 0.0)
            x[:, self.filters] += np.einsum("brq,bq->br", self.ramp, jump)
        x[:, self.measured] = np.where(missing, expected, y)

    def follow(self, x: Array, following: Array, missing: npt.NDArray[np.bool_], moving: Any = slice(None)) -> None:
        """Change over to the fallback in the next states (batch, n), and move levels, ramps and offsets on; x as `fill` left it."""
        bank, some = self.bank, missing.any(axis=1)
        last = x[:, : self.recorded].copy()
        last[:, self.measured] = np.where(missing, self.held, last[:, self.measured])
        offset = bank.forget * (last - x[:, self.fallback])
        count = np.where(missing, self.count + 1, 0.0)
        age = np.maximum(np.where(some, self.age, bank.recovery * self.age), count.max(axis=1, initial=0.0))
        share = bank.share(age / (age + bank.half))
        fallback = following[:, self.fallback] + offset
        self.filtered, self.expected = following[:, : self.recorded].copy(), fallback
        following[:, : self.recorded] += share * (fallback - following[:, : self.recorded])
        if some.any() or self.count.any():
            ramp = self.ramp.swapaxes(1, 2) @ self._A.T + (self._B * count[:, None, :]).swapaxes(1, 2)
            self.ramp[moving] = np.where(missing[..., None], ramp, 0.0).swapaxes(1, 2)[moving]
        self.offset[moving], self.age[moving], self.count[moving] = offset[moving], age[moving], count[moving]
