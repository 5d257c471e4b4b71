"""The step (18)-(21), written once: the state of observers over a batch of machines, and how a sample moves it on."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import numpy.typing as npt

from ..loops import formulas, library, tape_of
from .data import ObserverData
from .filter_bank import Gaps
from .guard import bounds
from .origin import Origins
from .runtime import Runtime

Array = npt.NDArray[np.float64]
Flags = npt.NDArray[np.bool_]
Whole = npt.NDArray[np.intp]
Parameters = Mapping[str, npt.ArrayLike]
_PIECE = 256  # samples until the origins of machines that turn on are moved along


class Steps:
    """Observers of one model, side by side over a batch of machines, relative to their origins: ``[x_hat+; x^c+] = M [theta(x_hat); x^c; u; y]``."""

    def __init__(self, observers: Sequence[ObserverData], batch: int, values: Parameters) -> None:
        observer = observers[0]
        lifting = observer.lifting
        n, n_lifted, m = lifting.n_states, lifting.n_lifted, observer.B.shape[1]
        order = max(o.controller.n_states for o in observers)
        self.observers, self.lifting, self.values = observers, lifting, values
        self.map = np.stack([_padded(o, order) for o in observers])
        self._column = np.zeros((len(observers), self.map.shape[2], batch))
        self._next = np.empty((len(observers), n + order, batch))
        row, self._following = np.swapaxes(self._column, 1, 2), np.swapaxes(self._next, 1, 2)
        self._next_x, self._next_c = self._following[..., :n], self._following[..., n:]
        self.near, self._lifted = row[..., :n], row[..., :n_lifted]
        self._x_c, self._u = row[..., n_lifted : n_lifted + order], row[..., n_lifted + order : n_lifted + order + m]
        self._y, self._at = row[..., n_lifted + order + m :], places(observer.measured)
        self._plain = not (lifting.history or lifting.input_functions)
        self._earlier = np.zeros((len(observers), batch, len(lifting.window.earlier)))
        self._fresh = np.ones(batch, dtype=bool)
        self._limits = observer.runtime if observer.runtime.limited else None
        self._origins = Origins(observer, batch)
        self._gaps: Gaps | None = None
        if observer.bank is not None:
            self._gaps = Gaps(observer.bank, observer.A[:n, :n], observer.measured, len(observer.recorded), batch)
        self.correction: Array | None = None
        self.cut = np.zeros(self._next_x.shape)
        self._low, self._high = (
            np.array(side) for side in zip(*(bounds(o.guard, n, order) for o in observers), strict=True)
        )
        self.waiting = np.zeros(
            (len(observers), batch), dtype=bool
        )  # for a start: the next step would leave the bounds
        self.restart = np.zeros((len(observers), batch), dtype=bool)  # whether that ever happened

    @property
    def x(self) -> Array:
        """Estimates of the states, shape (observer, batch, n)."""
        return self.near if self._origins.at is None else self.near + self._origins.states

    def begin(self, y: Array, machines: Flags | None = None, u: Array | None = None) -> None:
        """Start all machines, or some, at measurements, shape (batch, q), and inputs where these are known, shape (batch, m)."""
        rows = slice(None) if machines is None else machines
        self._origins.put(y[:, 0], rows)
        for own, observer in zip(self.near, self.observers, strict=True):
            own[rows] = self._first(observer, y, u, self.values, slice(None))[rows]
        self._x_c[:, rows] = 0.0
        self._fresh[rows] = True
        self.waiting[:, rows] = False
        if self._gaps is not None:
            self._gaps.begin(rows)

    def _first(self, observer: ObserverData, y: Array, u: Array | None, values: Parameters, machines: Any) -> Array:
        """First estimates of some machines, relative to their origins."""
        origins = self._origins
        if origins.at is None:
            return observer.runtime.relifted(observer.initial(y, values, u))
        moved = origins.states[machines]
        moved[..., self._at] = 0.0  # what is measured starts at the measurement
        first = observer.initial(y - origins.at[machines, None], values) - moved
        return self._relifted(observer.runtime, first, machines)

    def _relifted(self, limits: Runtime, x: Array, machines: Any) -> Array:
        """Estimates that go on, relative to the origins of some machines, within limits."""
        if self._origins.at is None:
            return limits.relifted(x)
        at = limits.clipped_states(x.shape[-1])
        moved, within = self._origins.states[machines], x.copy()
        within[..., at] = limits.relifted(x + moved)[..., at] - moved[..., at]
        return within

    def place(self, x: Array, earlier: Array) -> None:
        """Put states, shape (batch, n), and earlier values in place; corrections start at rest."""
        self._origins.at = None
        self.waiting[...] = False
        self.near[...], self._x_c[...], self._earlier[...], self._fresh[:] = x, 0.0, earlier, False
        self._origins.follow(self.near)

    def earlier(self, u: Array) -> Array:
        """Return the earlier values that the lifting reads, shape (observer, batch, n_earlier); after a start they equal the present ones."""
        if self._fresh.any():
            held = self.lifting.window.hold(self.near, np.broadcast_to(u, (*self.near.shape[:2], u.shape[-1])))
            return np.where(self._fresh[:, None], held, self._earlier)
        return self._earlier

    def innovation(self, y: Array) -> Array:
        """Return ``y - C x_hat``, shape (observer, batch, q); zero where a measurement is missing."""
        apart = self.apart(y)
        return np.where(np.isfinite(y), apart, 0.0)

    def apart(self, y: Array) -> Array:
        """Return ``y - C x_hat``, shape (observer, batch, q), not finite where y is not."""
        y = y if self._origins.at is None else y - self._origins.at[:, None]
        return np.asarray(y - self.near[..., self._at])

    def step(self, y: Array, u: Array, missing: Flags | None = None, moving: Flags | None = None) -> None:
        """Take measurements, shape (batch, q), and inputs, shape (batch, m); missing (batch, q), moving (batch,)."""
        lifting, following_earlier = self.lifting, None
        y, u = self._origins.take_off(y, u)
        if self._gaps is not None:
            absent = np.zeros(y.shape, dtype=bool) if missing is None else missing
            self._gaps.fill(self.near[0], y, absent)
            y, missing = self.near[0][..., self._at], None
        if self._plain:
            lifting.lift_into(self._lifted, self.values)
            self._u[...] = u
        else:
            u = np.broadcast_to(u, (*self.near.shape[:2], u.shape[-1]))
            earlier = self.earlier(u)
            window = np.concatenate([self.near, earlier], axis=-1)
            lifting.lift_into(self._lifted, self.values, earlier)
            self._u[...] = lifting.lift_inputs(u, window, self.values)
            following_earlier = lifting.window.advance(window, u)
        self._y[...] = y
        if missing is not None:  # what is predicted stands for what is missing, so that it corrects nothing
            np.copyto(self._y, self.near[..., self._at], where=missing)
        np.matmul(self.map, self._column, out=self._next)
        if self._gaps is not None:
            self._gaps.follow(self.near[0], self._next_x[0], absent)
        if self._limits is not None:
            self._limit()
        moving = self._guarded(moving)
        if moving is None:
            self.near[...] = self._next_x
            self._x_c[...] = self._next_c
        else:
            np.copyto(self.near, self._next_x, where=moving[..., None])
            np.copyto(self._x_c, self._next_c, where=moving[..., None])
        if following_earlier is not None:
            np.copyto(self._earlier, following_earlier, where=True if moving is None else moving[..., None])
            self._fresh &= False if moving is None else ~moving.all(axis=0)
        self._origins.follow(self.near)

    def _guarded(self, moving: Flags | None) -> Flags | None:
        """Return which observers and machines take the step, shape (observer, batch): none that wait, and none that would leave the bounds."""
        following = self._following
        if self._origins.at is not None:
            following = following.copy()
            following[..., : self.near.shape[2]] += self._origins.states
        within = ((following >= self._low[:, None]) & (following <= self._high[:, None])).all(axis=-1)
        if moving is None and within.all() and not self.waiting.any():
            return None
        going = ~self.waiting if moving is None else moving & ~self.waiting
        self.waiting |= going & ~within
        self.restart |= self.waiting
        return going & within

    def through(
        self,
        y: Array | None,
        u: Array,
        late: int = 0,
        moving: Flags | None = None,
        starts: Flags | None = None,
        states: Array | None = None,
        innovation: Array | None = None,
        before: tuple[Array, Whole] | None = None,
    ) -> None:
        """Take many samples, compiled where there is a compiler; y (n_samples, batch, q), u (n_samples, batch, m)."""
        gaps = self._gaps is not None and y is not None and not np.isfinite(y).all()
        if library() is None or gaps:
            self._one_by_one(y, u, late, moving, starts, states, innovation, before)
        elif self._origins.at is None and (y is None or not self._origins.beyond(y)):
            self._compiled(y, u, late, moving, starts, states, innovation, before, self._begins(y, u, starts))
        else:
            self._in_pieces(y, u, late, moving, starts, states, innovation)

    def _in_pieces(
        self,
        y: Array | None,
        u: Array,
        late: int,
        moving: Flags | None,
        starts: Flags | None,
        states: Array | None,
        innovation: Array | None,
    ) -> None:
        """`through` for machines that turn on and on: between pieces the origins follow. A start is not the first sample of a piece."""
        taken, first = u[np.maximum(np.arange(len(u)) - late, 0)] if late else u, 0
        while first < len(u):
            last = min(first + _PIECE, len(u))
            while starts is not None and last < len(u) and starts[last].any():
                last += 1
            if first:
                self._origins.follow(self.near)
            rows = slice(first, last)
            given, inputs = self._origins.take_off(np.zeros((1, u.shape[1], 1)) if y is None else y[rows], taken[rows])
            flags, anew = (None if every is None else every[rows] for every in (moving, starts))
            found, apart = (None if every is None else every[rows] for every in (states, innovation))
            begins = None if y is None else self._begins(y[rows], u[rows], anew)
            self._compiled(None if y is None else given, inputs, 0, flags, anew, found, apart, None, begins)
            if found is not None and self._origins.at is not None:
                found += self._origins.states.T
            first = last

    def _compiled(
        self,
        y: Array | None,
        u: Array,
        late: int,
        moving: Flags | None,
        starts: Flags | None,
        states: Array | None,
        innovation: Array | None,
        before: tuple[Array, Whole] | None,
        begins: dict[str, Any] | None,
    ) -> None:
        """Take many samples relative to the origins, compiled; machines start anew with `begins`."""
        loops, batch = library(), u.shape[1]
        assert loops is not None
        observer, lifting, limits = self.observers[0], self.lifting, self._limits
        job: dict[str, Any] = {
            "observers": len(self.observers),
            "samples": len(u),
            "batch": batch,
            "order": self._x_c.shape[2],
            "q": len(observer.measured),
            "late": late,
            "map": self.map,
            "y": None if y is None else y.swapaxes(1, 2),
            "u": u.swapaxes(1, 2),
            "measured": observer.measured,
            "moving": moving,
            "column": self._column,
            "past": self._earlier,
            "fresh": self._fresh.view(np.uint8),
            "low": self._low,
            "high": self._high,
            "origin": None if self._origins.at is None else self._origins.states.T,
            "waiting": self.waiting.view(np.uint8),
            "restart": self.restart.view(np.uint8),
            "overwrite": int(self._gaps is not None),
            "states": states,
            "innovation": innovation,
        }
        if before is not None:
            job |= {"before": before[0], "pending": before[1]}
        job |= begins or {}
        if limits is not None:
            K, n = observer.controller, lifting.n_states
            if limits.correction is not None:
                job |= {
                    "width": len(limits.correction),
                    "limit": limits.correction,
                    "limit_c": K.C,
                    "limit_d": K.D,
                    "into": observer.into[:n],
                }
            if limits.relift and not (limits.lower is None and limits.upper is None):
                sides = ((limits.lower, -np.inf), (limits.upper, np.inf))
                moved = 0.0 if self._origins.at is None else self._origins.states.T
                sizes = (np.full(n, none) if side is None else side for side, none in sides)
                job |= dict(
                    zip(("lower", "upper"), (np.tile(side[:, None], batch) - moved for side in sizes), strict=True)
                )
        loops.call(
            "kros_relift",
            formulas(lifting, tape_of(lifting, u.shape[2]), self.values, u.shape[2], batch),
            ("relift_job", job),
        )

    def _begins(self, y: Array | None, u: Array, starts: Flags | None) -> dict[str, Any]:
        """Estimates of machines that start after the first sample, and which they are; nothing where none does."""
        if starts is None or not starts[1:].any():
            return {}
        assert y is not None
        rows, machines = np.nonzero(starts)
        rows, machines = rows[rows > 0], machines[rows > 0]
        number = np.zeros(starts.shape, dtype=np.int32)
        number[rows, machines] = 1 + np.arange(len(rows))
        own = {
            name: np.broadcast_to(np.asarray(v, dtype=float), starts.shape[1:])[machines]
            for name, v in self.values.items()
        }
        first = y[rows, machines], u[rows, machines]
        begun = np.stack([self._first(o, *first, own, machines) for o in self.observers])
        return {"begin": number, "begun": begun, "begins": len(rows)}

    def _one_by_one(
        self,
        y: Array | None,
        u: Array,
        late: int,
        moving: Flags | None,
        starts: Flags | None,
        states: Array | None,
        innovation: Array | None,
        before: tuple[Array, Whole] | None,
    ) -> None:
        """`through` without a compiler."""
        n_samples, batch = u.shape[:2]
        y = np.full((n_samples, batch, len(self.observers[0].measured)), np.nan) if y is None else y
        missing = ~np.isfinite(y)
        starts = np.zeros((n_samples, batch), dtype=bool) if starts is None else starts
        gone, anew = (np.atleast_1d(flags.any(axis=axes)) for flags, axes in ((missing, (1, 2)), (starts, 1)))
        with np.errstate(over="ignore", invalid="ignore"):
            for k in range(n_samples):
                if states is not None:
                    states[k] = self.x.swapaxes(1, 2)
                if before is not None:
                    before[0][k] = self.earlier(u[k - before[1][k], np.arange(batch)])[0]
                if anew[k] and k:
                    self.begin(y[k], starts[k], u[k])
                if innovation is not None:
                    innovation[k] = self.innovation(y[k])[0]
                if moving is None or moving[k].any():
                    self.step(y[k], u[k - late], missing[k] if gone[k] else None, None if moving is None else moving[k])

    def _limit(self) -> None:
        """Keep corrections and estimates within their limits."""
        assert self._limits is not None
        observer, n = self.observers[0], self.near.shape[2]
        K = observer.controller
        if self._limits.correction is not None:
            self.correction = self._x_c @ K.C.T + (self._y - self.near[..., self._at]) @ K.D.T
            clipped = self._limits.clip_correction(self.correction)
            self._next_x += (clipped - self.correction) @ observer.into[:n].T
        within = self._relifted(self._limits, self._next_x, slice(None))
        np.subtract(within, self._next_x, out=self.cut)
        self._next_x[...] = within


def places(measured: Sequence[int]) -> Any:
    """Return an index of measured states: a slice where they follow one another, which costs no gather."""
    first, count = measured[0] if measured else 0, len(measured)
    return slice(first, first + count) if list(measured) == list(range(first, first + count)) else np.array(measured)


def _padded(observer: ObserverData, order: int) -> Array:
    """The one-step map with silent controller states up to an order."""
    n, nl, own = observer.lifting.n_states, observer.lifting.n_lifted, observer.controller.n_states
    missing = order - own
    step = np.insert(observer.one_step, [nl + own] * missing, 0.0, axis=1)
    return np.ascontiguousarray(np.insert(step, [n + own] * missing, 0.0, axis=0))
