r"""What makes an observer a filter bank: how it starts, and what it knows where measurements are missing.

While measurements arrive, a filter bank feeds nothing back that it estimates. Behind the recorded states x its
internal states are the filters z of measurements and inputs, whose estimate is given then; the estimate :math:`x^s`
from these for the time after a start, and then, in its place, the RMS errors that starts and losses make; the filters
w of inputs alone; and their estimate :math:`x^u` of all recorded states, the fallback. Of filters and measurements,
with e the one-step errors of training (variance :math:`n^2`),

.. math:: z_{k+1} = A z_k + b y_k + \dots, \qquad y_{k+1} = C z_k + D y_k + \dots + e_{k+1},

is a model in innovation form. A missing measurement is replaced by its estimate s, and a **Kalman filter** for this
model says what filters and substitutes are worth: with P the covariance of the errors of z and s,

.. math:: P_k \leftarrow P_k - K_j P_{j,k}, \quad K_j = P_{\cdot j} / (P_{jj} + n_j^2), \qquad P_{k+1} = T P_k T',
   \quad T = \begin{bmatrix} A & b \\ C & D \end{bmatrix},

and z and the other substitutes move by :math:`K_j (y_j - s_j)` for each measurement j that arrives, whose error is
zero then; that of a missing one gets the variance :math:`n_j^2`. At a start z is what it is where nothing has moved
before, and P its error amid training episodes; a linear model says little of errors that large, and in :math:`K_j`,
:math:`P_{jj}` counts :math:`1 + (1 + k)^{-4}` times, k measurements after it. As A is stable, all this is forgotten: P
is set to zero where it changes no estimate, and nothing is corrected any more. Functions of measurements enter b and D
by their slopes.

Of states that are not measured, what follows from z is blended with the fallback as both are worth,

.. math:: x + m (x^u - x), \qquad m = v / (v + h^2),

v the variance of the estimate by P; h is chosen in training, and limits of the estimates hold before. Estimates of
measurements are within a reach of the fallback, less its error at the last one that was believed, since inputs alone
say little of where an integrating machine is. P stays as it is where a missing one is not known within this reach. So z
is bounded for any pattern of losses, whatever the model is (B. D. O. Anderson and J. B. Moore, Optimal Filtering, 1979;
B. Sinopoli et al., IEEE Trans. Autom. Control 49 (2004) 1453-1464).

After a start where nothing has moved before, :math:`x + m (x^s - x)` takes the place of x, :math:`m = a^2 / (1 +
a^2)`, with an age a that begins at :math:`0.1 e^5` and falls by a factor a sample. The first step decides: where its
errors are like those of recorded starts, P is zero from then on, and otherwise a.

A measurement is refused, and counts as missing, where it is further from its estimate than

.. math:: (b (1 + v) (1 + w / (1 + k)) + d \sqrt{P_{jj}}) (1 + r),

b the gate, k the measurements that were believed since a start, r those that were refused just before; P is that
before these. v is the largest r after which one was believed, and is forgotten as a start is: where measurements are
worse than in training, gates are wider. After as many refused in a row as were believed, less v, or as a start takes,
any measurement is believed. One that is believed after refusals, and is further away than P says by then, is a start:
what was known is of no use. The filters z start again, if all measurements are there, and those of inputs go on. Where
an input is not known beside a measurement, or for more than five samples, k is zero. At a start without all
measurements, inputs alone count until the first sample that has them; there the filters z start.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from ..core import AGREED, Array, Columns, Flags, Record, frozen
from .checked import floats


@frozen
class FilterBank:
    """Start and gaps of an observer that is a filter bank."""

    filters: int
    start: Array
    recovery: Array  # (1,), factor of the age of a start
    doubt: Array  # (filters, filters), P of z at a start
    half: Array  # (n,), h
    reach: Array  # (q,)
    noise: Array  # (q,), RMS errors of one step
    rest: Array  # (q,), errors of a first step where nothing has moved before
    gate: Array  # (q,)
    opening: Array  # (q,), w
    deviations: Array  # (q,), d
    persistence: Array  # (m,), by which factor a change of an input is followed by the next one

    def __post_init__(self) -> None:
        floats(self, "Filter bank", recovery="shares between 0 and 1", persistence="shares between 0 and 1")
        floats(self, "Filter bank", start="finite numbers", rest="positive", gate="positive")
        floats(self, "Filter bank", half="positive and finite", noise="positive and finite")
        floats(self, "Filter bank", reach="finite and not negative", opening="finite and not negative")
        floats(self, "Filter bank", doubt="finite numbers", deviations="finite and not negative")

    @property
    def patience(self) -> int:
        """Samples that a start takes: after as many refused in a row a measurement is believed."""
        return round(-5 / np.log(self.recovery[0]))

    def error_sizes(self, measured: Sequence[int]) -> Array:
        """Return the errors of recorded states to which those that losses make are compared, (n,)."""
        errors = self.half.copy()
        errors[list(measured)] = self.noise
        return errors


OLDEST = 0.1 * float(np.exp(5))  # age of a start
_WAITING = 2 * OLDEST  # stands for it until a sample has all measurements


class Gaps:
    """State of the gaps of filter banks over a batch of machines."""

    def __init__(self, bank: FilterBank, A: Array, measured: Columns, limits: tuple[Array, Array], batch: int) -> None:
        n, recorded = len(A), len(limits[0])
        self.limits = limits
        self.bank, self.measured, self.recorded = bank, list(measured), recorded
        self.filters = slice(recorded, recorded + bank.filters)
        self.errors, self.from_inputs = slice(n - 2 * recorded, n - recorded), slice(n - recorded, n)
        self._from_filters = A[: self.filters.stop, self.filters]
        self.hidden = ~np.isin(np.arange(recorded), self.measured)
        self.take(np.zeros((5 * len(measured) + 1 + (bank.filters + len(measured)) ** 2, batch)))

    def take(self, state: Array) -> None:
        """Go on from a state: refused and believed measurements, gates, drift, age of the last start, covariance."""
        q = len(self.measured)
        self.state = state
        self.refusals, self.believed, self.width, self.unrest, self.drift, self.start, spread = np.split(
            state.T, np.cumsum([q, q, q, q, q, 1]), axis=1
        )
        self.spread = spread.reshape(len(spread), q + self.bank.filters, -1)

    def begin(self, rows: Any, missing: Flags) -> None:
        """Start some machines at measurements of which some may be missing."""
        self.state[:, rows] = 0.0
        self.start[rows] = np.where(missing.any(axis=1, keepdims=True), _WAITING, OLDEST)[rows]
        r = self.bank.filters
        self.spread[rows, :r, :r] = ~self.waiting[rows, None, None] * self.bank.doubt

    @property
    def waiting(self) -> Flags:
        """The machines whose filters wait for a sample that has all measurements."""
        return self.start[:, 0] > OLDEST

    @property
    def variance(self) -> Array:
        """Variances of the errors of measurements' estimates by what is missing, (batch, q)."""
        return np.maximum(np.diagonal(self.spread, axis1=1, axis2=2)[:, self.bank.filters :], 0.0)  # up to rounding

    def gated(self, x: Array, y: Array) -> Array:
        """Return measurements (batch, q), NaN in place of those that are too far from their estimates to be true."""
        apart, bank, waiting = abs(y - x[:, self.measured]), self.bank, self.waiting[:, None]
        near = bank.gate * (1 + self.unrest) * (1 + bank.opening / (1 + self.believed))
        width = bank.deviations * np.sqrt(self.variance)
        self.width[...] = np.where((self.refusals > 0) & np.isfinite(y), self.width, width)
        far = (apart > (near + self.width) * (1 + self.refusals)) & ~waiting
        refused = far & (self.refusals < np.minimum(bank.patience, self.believed - self.unrest))
        starts = (apart > near + width) & (self.refusals > 0) & ~refused & ~waiting
        shown = np.where(refused, np.nan, y)
        self.start[starts.any(axis=1) & np.isfinite(shown).all(axis=1)] = _WAITING
        self.believed[starts] = 0.0
        unrest = np.maximum(self.unrest * bank.recovery, self.refusals)
        self.unrest[...] = np.where(np.isfinite(shown), unrest, self.unrest)
        self.refusals[...] = np.where(np.isfinite(y), refused * (self.refusals + 1), self.refusals)
        return shown

    def fill(self, x: Array, y: Array, missing: Flags) -> None:
        """Put measurements (batch, q) and substitutes of missing ones into states (batch, n); correct the filters."""
        r, spread, knows = self.bank.filters, self.spread, ~self.waiting
        expected = x[:, self.measured]
        self._settle(y - expected)
        for j, variance in enumerate(self.bank.noise**2):
            arrived, lost = knows & ~missing[:, j], knows & missing[:, j]
            column = spread[:, :, r + j].copy()
            share = arrived / (column[:, r + j] * (1 + (1 + self.believed[:, j]) ** -4) + variance)
            step = column * (share * np.where(arrived, y[:, j] - expected[:, j], 0.0))[:, None]
            x[:, self.filters] += step[:, :r]
            expected += step[:, r:]
            spread -= column[:, :, None] * column[:, None, :] * share[:, None, None]
            spread[arrived, r + j], spread[arrived, :, r + j] = 0.0, 0.0
            spread[lost, r + j, r + j] += variance
        fallback = x[:, self.from_inputs][:, self.measured]
        self.drift[...] = np.where(missing, self.drift, y - fallback)
        x[:, self.measured] = np.where(missing, self._within_reach(expected, fallback), y)

    def _within_reach(self, expected: Array, fallback: Array) -> Array:
        """Return estimates of measurements, no further from the fallback, moved by its drift, than a reach."""
        near = fallback + self.drift
        return near + np.clip(expected - near, -self.bank.reach, self.bank.reach)

    def _settle(self, apart: Array) -> None:
        """Drop the doubt of machines whose first step is as if nothing has moved before, and age others."""
        first = (self.believed == 1).all(axis=1) & np.isfinite(apart).all(axis=1)
        still = (abs(apart) <= self.bank.rest).all(axis=1)
        self.spread[first & still] = 0.0
        self.start[first & ~still & ~self.waiting] = 0.0

    def begin_filters(self, lifted: Array, inputs: Array, missing: Flags) -> None:
        """Start the filters of measurements of machines that waited for all measurements."""
        ready = self.waiting & ~missing.any(axis=1)
        known = np.concatenate([lifted[ready], inputs[ready]], axis=-1)
        lifted[ready, self.filters] = known @ self.bank.start[self.filters].T
        self.start[ready], self.believed[ready], self.spread[ready] = OLDEST, 0.0, 0.0
        self.spread[ready, : self.bank.filters, : self.bank.filters] = self.bank.doubt

    def follow(self, following: Array, missing: Flags, slopes: Array | None) -> None:
        """Blend the fallback into the next states (batch, n) and move covariance and ages on.

        Slopes are those of the next states and filters by the measurements, (batch, n + filters, q), where one is
        missing.
        """
        n, half = self.recorded, self.bank.half
        variance = self._spread_on(missing, slopes)
        weight = np.where(self.waiting[:, None], 1.0, self.hidden * variance / (variance + half**2))
        recorded, age = following[:, :n], self.start**2
        recorded += age / (1 + age) * (following[:, self.errors] - recorded)
        np.clip(recorded, *self.limits, out=recorded)
        fallback, at = following[:, self.from_inputs], self.measured
        recorded += weight * (fallback - recorded)
        recorded[:, at] = self._within_reach(recorded[:, at], fallback[:, at])
        following[:, self.errors] = np.sqrt(variance)
        self.start[~self.waiting] *= self.bank.recovery
        self.believed += ~missing

    def _spread_on(self, missing: Flags, slopes: Array | None) -> Array:
        """Move the covariance on; return variances of the next recorded states, (batch, n)."""
        n, q, bank = self.recorded, len(self.measured), self.bank
        if slopes is None and not self.spread.any():
            return np.zeros((len(missing), n))
        by = np.zeros((1, len(self._from_filters), q)) if slopes is None else slopes
        rows = [*range(n, n + bank.filters), *self.measured]
        T = np.concatenate([np.broadcast_to(self._from_filters, (len(by), *self._from_filters.shape)), by], axis=2)
        moved = T @ self.spread
        variance = np.maximum((moved[:, :n] * T[:, :n]).sum(axis=2), 0.0)
        spread = moved[:, rows] @ T[:, rows].swapaxes(1, 2)
        spread = np.tril(spread) + np.tril(spread, -1).swapaxes(1, 2)
        lost = ((variance[:, self.measured] > bank.reach**2) & missing).any(axis=1)
        forgotten = ~missing.any(axis=1) & (variance <= AGREED * bank.error_sizes(self.measured) ** 2).all(axis=1)
        spread[forgotten] = 0.0
        self.spread[~lost] = spread[~lost]
        return variance

    @property
    def job(self) -> Record:
        """What the compiled loop needs of gaps."""
        bank = self.bank
        return {
            "recorded": self.recorded,
            "filters": bank.filters,
            "reach": bank.reach,
            "noise": bank.noise,
            "rest": bank.rest,
            "gate": bank.gate,
            "opening": bank.opening,
            "deviations": bank.deviations,
            "start": bank.start[self.filters],
            "patience": bank.patience,
            "limits": np.array(self.limits),
            "half": bank.half,
            "recovery": bank.recovery,
            "doubt": bank.doubt,
            "gap": self.state.copy(),
        }
