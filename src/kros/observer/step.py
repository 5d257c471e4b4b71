"""The step (18)-(21) in NumPy, the reference for all generated code."""

from __future__ import annotations

from typing import Any

import numpy as np

from ..core.arrays import Array, Flags, Index, Parameters, Record
from .data import ObserverData
from .filter_bank import Gaps
from .runtime import bounds


class Steps:
    """An observer over a batch of machines: ``[x_hat+; x^c+] = M [theta(x_hat); x^c; u; y]``."""

    def __init__(self, observer: ObserverData, batch: int, values: Parameters) -> None:
        lifting, order = observer.lifting, observer.controller.n_states
        n = lifting.n_states
        self.observer, self.lifting, self.values = observer, lifting, values
        self._map, self._measured = observer.one_step, list(observer.measured)
        self._correction = slice(lifting.n_lifted, lifting.n_lifted + order)
        self.x, self.x_c = np.zeros((batch, n)), np.zeros((batch, order))
        self.past, self.fresh = np.zeros((batch, len(lifting.window.earlier))), np.ones(batch, dtype=bool)
        self._low, self._high = bounds(observer.guard, n, order)
        self.waiting = np.zeros(batch, dtype=bool)  # for a start: the next step would leave the bounds
        self.refused = np.zeros(batch, dtype=bool)  # whether a measurement was too far from its estimate
        self.gaps: Gaps | None = None
        if observer.bank is not None:
            limits = observer.runtime.sides(len(observer.recorded))
            self.gaps = Gaps(observer.bank, observer.A[:n, :n], observer.measured, limits, batch)

    def begin(self, y: Array, machines: Flags | None = None, u: Array | None = None) -> None:
        """Start machines at measurements, (batch, q), and inputs where these are known, (batch, m)."""
        rows: Any = slice(None) if machines is None else machines
        self.x[rows] = self.observer.initial(y, self.values, u)[rows]
        self.x_c[rows], self.fresh[rows], self.waiting[rows] = 0.0, True, False
        if self.gaps is not None:
            self.gaps.begin(rows, ~np.isfinite(y))

    def earlier(self, u: Array) -> Array:
        """Return the earlier values, (batch, n_earlier); after a start they equal the present ones."""
        if not self.fresh.any():
            return self.past
        held = self.lifting.window.hold(self.x, np.broadcast_to(u, (len(self.x), u.shape[-1])))
        return np.where(self.fresh[:, None], held, self.past)

    def innovation(self, y: Array) -> Array:
        """Return ``y - C x_hat``, shape (batch, q); not finite where y is not."""
        return y - self.x[:, self._measured]

    def step(self, y: Array, u: Array, moving: Flags | None = None) -> None:
        """Take measurements, shape (batch, q), not finite where one is missing, and inputs, shape (batch, m)."""
        n, missing = self.lifting.n_states, ~np.isfinite(y)
        u = np.broadcast_to(u, (len(self.x), u.shape[-1]))
        if self.gaps is not None:
            y = self.gaps.gated(self.x, y)
            self.refused[:] = (np.isnan(y) & ~missing).any(axis=1)
            missing = ~np.isfinite(y)
            self.gaps.fill(self.x, y, missing)
        y = np.where(missing, self.x[:, self._measured], y)  # what is predicted corrects nothing
        delays = self.past.shape[1] > 0
        window = np.concatenate([self.x, self.earlier(u)], axis=-1) if delays else self.x
        theta, inputs = self.lifting.lift(window, self.values), self.lifting.lift_inputs(u, window, self.values)
        if self.gaps is not None:
            self.gaps.begin_filters(theta, inputs, missing)
        following = np.concatenate([theta, self.x_c, inputs, y], axis=-1) @ self._map.T
        if self.gaps is not None:
            self.gaps.follow(following[:, :n], missing, self._slopes(window, u) if missing.any() else None)
        within = ((following >= self._low) & (following <= self._high)).all(axis=-1)
        going = ~self.waiting if moving is None else moving & ~self.waiting
        self.waiting |= going & ~within  # a step that would leave the bounds is not taken
        on = (going & within)[:, None]
        np.copyto(self.x, following[:, :n], where=on)
        np.copyto(self.x_c, following[:, n:], where=on)
        if delays:
            np.copyto(self.past, self.lifting.window.advance(window, u), where=on)
            self.fresh &= ~on[:, 0]

    @property
    def job(self) -> Record:
        """What the compiled loop goes on from."""
        column = np.zeros((self._map.shape[1], len(self.x)))
        column[: self.lifting.n_states] = self.x.T
        column[self._correction] = self.x_c.T
        job = {
            "order": self.x_c.shape[1],
            "q": len(self._measured),
            "map": self._map,
            "measured": self._measured,
            "past": self.past.copy(),
            "fresh": int(self.fresh.any()),
            "left": np.zeros(1, np.uint8),
            "low": self._low,
            "high": self._high,
            "column": column,
        }
        return job if self.gaps is None else job | self.gaps.job

    def take(self, job: Record) -> None:
        """Go on from where the compiled loop ended."""
        column = job["column"]
        self.x, self.x_c = column[: self.lifting.n_states].T.copy(), column[self._correction].T.copy()
        self.past, self.fresh = job["past"], np.zeros_like(self.fresh)
        if self.gaps is not None:
            self.gaps.take(job["gap"])

    def _slopes(self, window: Array, u: Array) -> Array:
        """Return the slopes of the next recorded states and filters by measurements, (batch or 1, n + filters, q)."""
        assert self.gaps is not None
        observer, names = self.observer, self.lifting.states
        by = tuple(names[i] for i in self._measured)
        end = self.gaps.filters.stop
        A, B = observer.A[:end], observer.B[:end, u.shape[1] :]
        lifted = A[:, len(names) :] @ self.lifting.slopes(window, self.values, by)
        return A[:, self._measured] + lifted + B @ self.lifting.slopes(window, self.values, by, u)


def forward(observer: ObserverData, values: Parameters, count: Index, x: Array, earlier: Array, u: Array) -> Array:
    """Predict states (batch, n) over the first ``count`` inputs of u (d, batch, m), without correction."""
    steps, missing = Steps(observer, len(x), values), np.full((len(x), len(observer.measured)), np.nan)
    steps.x[...], steps.past[...], steps.fresh[:] = x, earlier, False
    steps.gaps = None  # of filter banks, what is predicted stands for measurements, as in generated C
    for j, inputs in enumerate(u):
        steps.step(missing, inputs, j < count)
    return steps.x
