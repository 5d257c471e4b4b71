r"""What makes an observer a filter bank: how it starts, and what replaces missing measurements.

While measurements arrive, a filter bank feeds nothing back that it estimates. Behind the recorded states x its
internal states are the filters z of measurements and inputs, whose estimate is given then, and the filters w of
inputs alone with their own estimate :math:`x^u` of all recorded states. The fallback

.. math:: f_{k+1} = x^u_{k+1} + o_{k+1}, \qquad o_{k+1} = \rho \, (o_k + (1 - m) (x_k - x^u_k - o_k)),

continues the last estimate (of measured states, for which m is zero here, the last measurement) and tends to
:math:`x^u`; estimates in which the fallback counts already change it less, since they say little. The age a of a gap is
the number of samples that are missing so far; when measurements return it falls by a factor :math:`\mu` a sample, as
the filters forget what stood for them. Every state has its own :math:`\mu`: a state that is estimated from slow
filters is wrong for longer. Then it counts as :math:`0.1 e^5 T` at most, so that m is below one percent after five time
constants of :math:`\mu`. The estimate of a state that is not measured is

.. math:: x_{k+1} + m \, (f_{k+1} - x_{k+1}), \qquad m = a^2 / (a^2 + T^2).

A missing measurement is replaced by its estimate, at most :math:`1 - m` times a reach away from the fallback: what
the filters see is bounded for any pattern of losses, and so are they. When a measurement returns, the gap is bridged
by a straight line: the response r of the filters to a unit ramp was run along, and ``z`` is corrected by
:math:`r (y - \hat y) / (g + 1)` after g samples.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from ..core import Array, Columns, Flags, Record, frozen
from .checked import floats


@frozen
class FilterBank:
    """Start and gaps of an observer that is a filter bank."""

    filters: int
    start: Array
    forget: Array
    half: Array
    recovery: Array
    reach: Array

    def __post_init__(self) -> None:
        shares = dict.fromkeys(("forget", "recovery"), "shares between 0 and 1")
        kinds = {"start": "finite numbers", "half": "positive and finite", "reach": "finite and not negative"}
        floats(self, "Filter bank", **kinds, **shares)

    def level(self, age: Array) -> Array:
        """Return m of every recorded state at ages, shape (..., n)."""
        ratio = age / self.half
        return ratio * ratio / (1 + ratio * ratio)


def longest_age(half: Array) -> Array:
    """Return the largest ages that count when measurements return: m is then below 1 % after five time constants."""
    return 0.1 * np.exp(5) * half


class Gaps:
    """State of the gaps of filter banks over a batch of machines."""

    def __init__(self, bank: FilterBank, A: Array, measured: Columns, recorded: int, batch: int) -> None:
        n, q = len(A), len(measured)
        self.bank, self.measured, self.recorded = bank, list(measured), recorded
        self.filters = slice(recorded, recorded + bank.filters)
        self.fallback = slice(n - recorded, n)
        self._A, self._B = A[self.filters, self.filters], A[self.filters, :][:, self.measured]
        self.hidden = ~np.isin(np.arange(recorded), self.measured)
        self.held = np.zeros((batch, q))  # the fallback of measurements
        self.take(np.zeros((2 * recorded + q + q * bank.filters, batch)))

    def take(self, state: Array) -> None:
        """Go on from a state whose rows are offsets, ages, counts and ramps of all machines."""
        n, q = self.recorded, len(self.measured)
        self.state = state
        self.offset, self.age, self.count, ramp = np.split(state.T, np.cumsum([n, n, q]), axis=1)
        self.ramp = ramp.reshape(len(ramp), q, -1).swapaxes(1, 2)

    def begin(self, rows: Any) -> None:
        """Start some machines: nothing is missing."""
        self.state[:, rows] = 0.0

    def fill(self, x: Array, y: Array, missing: Flags) -> None:
        """Put measurements (batch, q) and substitutes of missing ones into states (batch, n); bridge gaps that end."""
        if not missing.any() and not self.count.any():
            x[:, self.measured] = y
            return
        self.held = (x[:, self.fallback] + self.offset)[:, self.measured]
        reach = (1 - self.bank.level(self.age)[:, self.measured]) * self.bank.reach
        near = np.clip(x[:, self.measured] - self.held, -reach, reach)
        expected = self.held + near
        ends = ~missing & (self.count > 0)
        if ends.any():
            jump = np.where(ends, (np.where(missing, 0.0, y) - expected) / (self.count + 1), 0.0)
            x[:, self.filters] += np.einsum("brq,bq->br", self.ramp, jump)
        x[:, self.measured] = np.where(missing, expected, y)

    def follow(self, x: Array, following: Array, missing: Flags) -> None:
        """Blend the fallback into the next states (batch, n) and move ages, ramps and offsets on; x is of `fill`."""
        bank, some = self.bank, np.asarray(missing.any(axis=1))
        last, fallback, share = x[:, : self.recorded].copy(), x[:, self.fallback], self.hidden * bank.level(self.age)
        last[:, self.measured] = np.where(missing, self.held, x[:, self.measured])
        offset = bank.forget * (last - fallback + share * (self.offset - last + fallback))
        count = np.where(missing, self.count + 1, 0.0)
        recovered = np.where(some[:, None], self.age, bank.recovery * np.minimum(self.age, longest_age(bank.half)))
        age = np.maximum(recovered, count.max(axis=1, keepdims=True, initial=0.0))
        share = self.hidden * bank.level(age)
        fallback = following[:, self.fallback] + offset
        following[:, : self.recorded] += share * (fallback - following[:, : self.recorded])
        if some.any() or self.count.any():
            ramp = self.ramp.swapaxes(1, 2) @ self._A.T + (self._B * count[:, None, :]).swapaxes(1, 2)
            self.ramp[...] = np.where(missing[..., None], ramp, 0.0).swapaxes(1, 2)
        self.offset[...], self.age[...], self.count[...] = offset, age, count

    @property
    def job(self) -> Record:
        """What the compiled loop needs of gaps."""
        bank = self.bank
        rows = bank.forget, bank.half, bank.recovery, longest_age(bank.half)
        return {
            "recorded": self.recorded,
            "filters": bank.filters,
            "reach": bank.reach,
            "bank": np.stack([np.broadcast_to(row, self.age.shape).T for row in rows]),
            "gap": self.state.copy(),
        }
