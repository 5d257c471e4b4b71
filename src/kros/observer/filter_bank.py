r"""What makes an observer a filter bank: how it starts, and what replaces missing measurements.

While measurements arrive, a filter bank feeds nothing back that it estimates. Behind the recorded states x its
internal states are the filters z of measurements and inputs, whose estimate is given then, estimates :math:`x^s` and
:math:`x^l` from these for the time after a start and after a loss, the filters w of inputs alone, their own estimate
:math:`x^u` of all recorded states, and the distance o from it, which decays as machines do by themselves. Before a step

.. math:: o_k \leftarrow o_k + (1 - m) (x_k - x^u_k - o_k), \qquad o_{k+1} = F o_k,

where m is zero for measurements, and one for all states while a measurement is missing: estimates that follow from
substitutes do not enter what substitutes follow from. So the fallback :math:`x^u + o` continues the last estimate and
tends to :math:`x^u`; estimates in which the fallback counts already change it less, since they say little. Before that,
measurements that have all arrived pull o by :math:`L (y - x^u - o)`, with L the regression of distances on those of
measurements by a covariance X. As :math:`F X F' \le X`, F and :math:`I - L C` are contractions in one norm: by turns,
they let no o grow. The age a of a gap is the number of samples that are missing so far; when measurements return it
falls by a factor a sample, counted as :math:`0.1 e^5 T` at most, so that m is below one percent as soon as the filters
have forgotten what stood for them, as after a start. Of several measurements, gaps of all and gaps of some have ages
and T of their own, and the larger m counts. The estimate of a state that is not measured is

.. math:: x_{k+1} + m \, (x^u_{k+1} + o_{k+1} - x_{k+1}), \qquad m = a^2 / (a^2 + T^2).

After a start, what happened before is not known; after a loss, filters hold what stood for measurements.
:math:`x + m (x^s - x)` takes the place of x, with T = 1 and an age of :math:`0.1 e^5` at a start, and then
:math:`x + m (x^l - x)`, with ages like those of the fallback and H in place of T, least for what stands for
measurements; these fall until no delay reaches back to a loss. Limits of the estimates hold before the fallback enters
them, so that little of what is far away is left in long gaps.

A measurement is refused, and counts as missing, where it is further from its estimate than :math:`b (1 + w / (1 + k))
(1 + g)^2 (1 + r)`. Here b is the gate, k are the measurements that were believed since a start, and g and r the samples
that were missing and refused just before. After as many refused in a row as were believed before, or as a start takes,
any measurement is believed. One that is further away than without r is a start, and k is zero again after one that is
further away than without g and r. If no more were believed before than refused since, what was known is of no use: the
filters z start again, if all measurements are there, and those of inputs, their estimate and its distance go on. At a
start without all measurements, inputs alone count until the first sample that has them; there the filters z start.

A missing measurement is replaced by its estimate, at most a reach away from the fallback (1 + a times as much at age a
of the first start, since inputs alone say little of where a machine is then), and o of states that are not
measured is no larger than theirs: what the filters see is bounded for any pattern of losses, and so are they. When a
measurement returns, the gap is bridged by a straight line: the response r of the filters to a unit ramp was run along,
through the slopes of lifted functions at what stood for the measurement, and ``z`` is corrected by :math:`r (y - \hat
y) / (g + 1)` after g samples.
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
    half: Array  # (2 or 4, n), H and T of losses of all measurements and, of several, of losses of some
    recovery: Array  # (2,), of the readout after losses, and of the fallback and a start
    reach: Array
    gate: Array
    opening: Array  # (q,), w
    pull: Array  # (n, q)

    def __post_init__(self) -> None:
        floats(self, "Filter bank", start="finite numbers", pull="finite numbers", recovery="shares between 0 and 1")
        floats(self, "Filter bank", half="positive and finite", gate="positive")
        floats(self, "Filter bank", reach="finite and not negative", opening="finite and not negative")

    @property
    def patience(self) -> int:
        """Samples that a start takes: after as many refused in a row a measurement is believed."""
        return round(-5 / np.log(self.recovery[1]))


def level(age: Array, half: Array | float = 1.0) -> Array:
    """Return m at ages of which it is one half at `half`."""
    ratio = age / half
    return ratio * ratio / (1 + ratio * ratio)


OLDEST = 0.1 * float(np.exp(5))  # largest age over `half` when measurements return, and age of a start
_WAITING = 2 * OLDEST  # stands for it until a sample has all measurements


class Gaps:
    """State of the gaps of filter banks over a batch of machines."""

    def __init__(self, bank: FilterBank, A: Array, measured: Columns, limits: tuple[Array, Array], batch: int) -> None:
        n, q, recorded = len(A), len(measured), len(limits[0])
        self.limits = limits
        self.bank, self.measured, self.recorded = bank, list(measured), recorded
        self.filters = slice(recorded, recorded + bank.filters)
        self.after_start, self.after_loss, self.from_inputs, self.offset = (
            slice(n - k * recorded, n - (k - 1) * recorded) for k in (4, 3, 2, 1)
        )
        self._A = A[self.filters, self.filters]
        self.hidden = ~np.isin(np.arange(recorded), self.measured)
        self._most = np.where(self.hidden, bank.reach, np.inf)
        self.take(np.zeros((bank.half.size + 3 * q + 2 + q * bank.filters, batch)))

    def take(self, state: Array) -> None:
        """Go on from a state: ages; missing, refused, believed samples; of the last and the first start; ramps."""
        n, q = self.bank.half.size, len(self.measured)
        self.state = state
        age, self.count, self.refusals, self.believed, self.start, ramp = np.split(
            state.T, np.cumsum([n, q, q, q, 2]), axis=1
        )
        self.age = age.reshape(len(age), *self.bank.half.shape)
        self.ramp = ramp.reshape(len(ramp), q, -1).swapaxes(1, 2)

    def begin(self, rows: Any, missing: Flags) -> None:
        """Start some machines at measurements of which some may be missing."""
        self.state[:, rows] = 0.0
        self.start[rows] = np.where(missing.any(axis=1, keepdims=True), [_WAITING, OLDEST], OLDEST)[rows]

    @property
    def waiting(self) -> Flags:
        """The machines whose filters wait for a sample that has all measurements."""
        return self.start[:, 0] > OLDEST

    def share(self, which: int) -> Array:
        """How much the readout after losses (0) or the fallback (1) counts, (batch, n)."""
        return np.where(self.waiting[:, None], 1.0, level(self.age, self.bank.half)[:, which::2].max(axis=1))

    @property
    def reach(self) -> Array:
        """How far what stands for measurements may be from the fallback, (batch, q)."""
        return self.bank.reach[self.measured] * (1 + self.start[:, 1:])

    def gated(self, x: Array, y: Array) -> Array:
        """Return measurements (batch, q), NaN in place of those that are too far from their estimates to be true."""
        apart, waiting = abs(y - x[:, self.measured]), self.waiting[:, None]
        near = self.bank.gate * (1 + self.bank.opening / (1 + self.believed))
        far, most = near * (1 + self.count - self.refusals) ** 2, np.minimum(self.bank.patience, self.believed)
        refused = (apart > far * (1 + self.refusals)) & (self.refusals < most) & ~waiting
        starts = (apart > far) & (self.refusals > 0) & ~refused & ~waiting
        self.start[starts.any(axis=1), 0] = OLDEST
        shown = np.where(refused, np.nan, y)
        outvoted = (starts & (self.refusals >= most)).any(axis=1) & np.isfinite(shown).all(axis=1)
        self.start[outvoted, 0] = _WAITING
        self.believed[(apart > near) & ~refused] = 0.0
        self.refusals[...] = np.where(np.isfinite(y), refused * (self.refusals + 1), self.refusals)
        return shown

    def fill(self, x: Array, y: Array, missing: Flags) -> None:
        """Put measurements (batch, q) and substitutes of missing ones into states (batch, n); bridge gaps that end."""
        share, recorded, offset = self.share(1), x[:, : self.recorded], x[:, self.offset]
        reach, held = self.reach, (x[:, self.from_inputs] + offset)[:, self.measured]
        expected = held + np.clip(x[:, self.measured] - held, -reach, reach)
        ends = ~missing & (self.count > 0) & ~self.waiting[:, None]
        jump = np.where(ends, (y - expected) / (self.count + 1), 0.0)
        x[:, self.filters] += np.einsum("brq,bq->br", self.ramp, jump)
        x[:, self.measured] = np.where(missing, expected, y)
        share[:, self.measured] = 0.0
        some = np.asarray(missing.any(axis=1))
        share[some] = 1.0
        distance = recorded - x[:, self.from_inputs]
        offset += np.where(some[:, None], 0.0, (distance - offset)[:, self.measured]) @ self.bank.pull.T
        offset += (1 - share) * (distance - offset)
        np.clip(offset, -self._most, self._most, out=offset)

    def begin_filters(self, lifted: Array, inputs: Array, missing: Flags) -> None:
        """Start the filters of measurements of machines that waited for all measurements."""
        ready = self.waiting & ~missing.any(axis=1)
        known = np.concatenate([lifted[ready], inputs[ready]], axis=-1)
        lifted[ready, self.filters] = known @ self.bank.start[self.filters].T
        self.start[ready, 0], self.believed[ready] = OLDEST, 0.0

    def follow(self, following: Array, missing: Flags, slopes: Array | None) -> None:
        """Blend the fallback into the next states (batch, n) and move ages and ramps on.

        Slopes are those of the next filters by the measurements, (batch, filters, q), where one is missing.
        """
        bank, some, none = self.bank, np.asarray(missing.any(axis=1)), np.asarray(missing.all(axis=1))
        count = np.where(missing, self.count + 1, 0.0)
        pairs = (none, some), (count.min(axis=1), count.max(axis=1) * ~none)
        lost, lengths = (np.stack(p, axis=1)[..., None].repeat(2, axis=1)[:, : len(bank.half)] for p in pairs)
        rates = np.resize(bank.recovery, (len(bank.half), 1))
        recovered = np.where(lost, self.age, rates * np.minimum(self.age, OLDEST * bank.half))
        self.age[...] = np.maximum(recovered, lengths)
        fallback, recorded = following[:, self.from_inputs] + following[:, self.offset], following[:, : self.recorded]
        recorded += level(self.start[:, :1]) * (following[:, self.after_start] - recorded)
        recorded += self.share(0) * (following[:, self.after_loss] - recorded)
        np.clip(recorded, *self.limits, out=recorded)
        recorded += self.hidden * self.share(1) * (fallback - recorded)
        at, reach = self.measured, self.reach
        near = fallback[:, at] + np.clip(recorded[:, at] - fallback[:, at], -reach, reach)
        recorded[:, at] = np.where(some[:, None], near, recorded[:, at])
        if slopes is None:
            self.ramp[...] = 0.0
        else:
            self.ramp[...] = np.where(missing[:, None], self._A @ self.ramp + slopes * count[:, None], 0.0)
        waiting = self.waiting
        self.count[...], self.start[...] = count, bank.recovery[1] * self.start
        self.believed += ~missing
        self.start[waiting, 0] = _WAITING

    @property
    def job(self) -> Record:
        """What the compiled loop needs of gaps."""
        bank = self.bank
        return {
            "recorded": self.recorded,
            "kinds": len(bank.half),
            "filters": bank.filters,
            "reach": bank.reach,
            "gate": bank.gate,
            "opening": bank.opening,
            "start": bank.start[self.filters],
            "pull": bank.pull,
            "patience": bank.patience,
            "limits": np.array(self.limits),
            "half": bank.half,
            "recovery": bank.recovery,
            "gap": self.state.copy(),
        }
