r"""The error of an observer that lifts its state at every step: a linear system with slopes in a box.

            ┌────────────────────────────┐
     w ────►│ xi+ = A xi + L p + B w     ├────► z = C xi
       ┌───►│ q   = M xi + E p + D w     ├───┐
     p │    └────────────────────────────┘   │ q
       └────────────── diag(d_k) ◄───────────┘            -1 <= d_k <= 1 in every entry, arbitrary from step to step

For a true trajectory ``x+ = f(x, u) + omega`` and measurements ``y = C x + n`` the error ``e = x - x_hat`` obeys this
exactly (`docs/proofs.md` has the proof). A lifted function moves by ``sigma_i(x) - sigma_i(x_hat) = s_i' e`` with s_i
its slope at a point between the two, hence in the box of its slopes; the middle of the box goes into A, every entry
that can move into a channel of its own.

Symbols
-------
xi        : [e, earlier errors that the lifting reads, x^c], with a delay followed by its residuals, the latest first,
and the predicted errors that count
w, z      : [omega / residual, n / noise] and e / error, the scaled signals of `ReliftScales`
p, q      : what the slopes' movement adds, and what it acts on
d_k       : position of every slope in its interval
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import field, replace

import numpy as np

from ...core import EPS, ROUNDING, Array, ArrayLike, DataError, DimensionError, KrosError, Names, StateSpace, frozen
from ...lifting.formula import delayed_name
from ...lifting.intervals import Box, break_of, slope_bounds_of
from ..checked import floats
from ..data import ObserverData

_WIDER = 1 + 4 * EPS  # centre and half width are rounded
_CONSTANT = 4 * ROUNDING  # interval bounds are widened by so much: a slope within that is constant


class UnboundedSlopeError(KrosError):
    """A lifted function may be arbitrarily steep where the observer may be."""


@frozen
class ReliftScales:
    """Sizes that turn a gain into a statement: errors are divided by `error`, residuals and noise by theirs.

    Parameters
    ----------
    error : ndarray, shape (n,)
        Range of every state: a scaled error of 0.01 is one percent of the largest value. Infinite for a state whose
        error does not count.
    residual : ndarray, shape (n,)
        Size of the one-step residual in every state; zero for a state without.
    noise : ndarray, shape (q,)
        Size of every measurement's noise.

    Examples
    --------
    >>> import numpy as np
    >>> from kros.observer import ReliftScales
    >>> scales = ReliftScales(error=np.array([2.0, 30.0]), residual=np.array([0.01, 0.2]), noise=np.array([1e-3]))
    >>> scales.error.tolist()
    [2.0, 30.0]
    """

    error: Array
    residual: Array
    noise: Array

    def __post_init__(self) -> None:
        others = dict.fromkeys(("residual", "noise"), "finite and not negative")
        floats(self, "Re-lift scales", error="positive", **others)
        if not np.isfinite(self.error).any():
            raise DataError(f"Re-lift scales: one of the errors at least should be finite, found {self.error}.")

    @classmethod
    def typical(cls, ranges: ArrayLike, residual: Array, noise: ArrayLike) -> ReliftScales:
        """Return the scales for which a population's residual has unit power: the gain is then a typical error.

        Of ranges, shape (n,), one-step residuals of the population, shape (..., n), and the standard deviation of every
        measurement's noise, shape (q,).
        """
        n, sigma = residual.shape[-1], np.atleast_1d(noise)
        rms = np.sqrt(np.mean(residual.reshape(-1, n) ** 2, axis=0))
        return cls(np.asarray(ranges), rms * np.sqrt(n), sigma * np.sqrt(len(sigma)))

    @classmethod
    def ones(cls, observer: ObserverData) -> ReliftScales:
        """Return the scales that change nothing."""
        n = len(observer.recorded)
        return cls(np.ones(n), np.ones(n), np.ones(len(observer.measured)))


@frozen
class ErrorSystem:
    """Linear part of the error dynamics with its channels, as drawn above."""

    A: Array  # (n_xi, n_xi)
    L: Array  # (n_xi, n_p)
    B: Array  # (n_xi, n_w)
    M: Array  # (n_p, n_xi)
    D: Array  # (n_p, n_w)
    C: Array  # (n_z, n_xi)
    dt: float  # s
    channels: Names = ()  # what moves in every channel, for people
    E: Array | float = 0.0  # (n_p, n_p): strictly triangular up to the order of channels; zero by default
    start: Array = field(default_factory=lambda: np.zeros((0, 0)))  # (n_xi, n_window): where the first error goes

    def multiplied(self, multipliers: Array, gain: float) -> tuple[tuple[Array, Array], Array, Array]:
        """Return (A, B), C and D with p as input and q as output: a gain proven for it holds in the whole box."""
        root = np.sqrt(multipliers)
        B = np.hstack([self.L / root * gain, self.B])
        C = np.vstack([_WIDER * root[:, None] * self.M, self.C])
        D = np.zeros((len(C), B.shape[1]))
        D[: len(root), : len(root)] = _WIDER * root[:, None] * self.E / root * gain
        D[: len(root), len(root) :] = _WIDER * root[:, None] * self.D
        return (self.A, B), C, D

    def frozen(self, d: ArrayLike) -> StateSpace:
        """Return the system from w to z with slopes that stay at a place d in the box, (n_p,)."""
        d = np.asarray(d, dtype=float)
        moved = self.L @ np.linalg.solve(np.eye(len(d)) - d[:, None] * self.E, np.diag(d))
        A, B = self.A + moved @ self.M, self.B + moved @ self.D
        return StateSpace(A, B, self.C, np.zeros((len(self.C), B.shape[1])), self.dt)

    def mismatch(self) -> ErrorSystem:
        """Return the system from q' (frozen) to the rest: ``r+ = A r + L p``, ``p = d (M r + E p + q')``."""
        width = self.L.shape[1]
        return replace(self, B=np.zeros_like(self.L), D=np.eye(width))


def error_system(
    observer: ObserverData, scales: ReliftScales | None = None, box: Box | None = None, parameters: Box | None = None
) -> ErrorSystem:
    """Return the error dynamics of an observer at run time, its delay included."""
    return _Assembly(observer, scales or ReliftScales.ones(observer), box, parameters).system()


class _Assembly:
    """The error dynamics while they are put together: rows of signals as functions of [xi, p, w]."""

    def __init__(self, observer: ObserverData, scales: ReliftScales, box: Box | None, parameters: Box | None) -> None:
        lifting, n, q = observer.lifting, observer.lifting.n_states, len(observer.measured)
        shapes = (scales.error.shape, scales.residual.shape, scales.noise.shape)
        if shapes != ((n,), (n,), (q,)):
            raise DimensionError(
                f"Re-lift scales of {observer.name}: needs {n} errors, {n} residuals, {q} noises, found {shapes}."
            )
        self.observer, self.scales, self.n = observer, scales, n
        self.delay, self.order = observer.runtime.delay, observer.controller.n_states
        lags = [(name, lag) for name, lag in lifting.window.quantities if name in lifting.states]
        self.names, self.h = [delayed_name(name, lag) for name, lag in lags], len(lags)
        lower, upper = slope_box(observer, self.names, box, parameters)
        self.columns = np.hstack([observer.A[:n, n:], observer.B[:n, len(observer.inputs) :]])
        middle, self.half = (lower + upper) / 2, (upper - lower) / 2 * _WIDER
        moves = (self.half > _CONSTANT * np.abs(middle)) & np.any(self.columns, axis=0)[:, None]
        self.moving, self.into = np.argwhere(moves), observer.into[:n]
        self.following = np.zeros((self.h, self.h))
        self.following[:n] = np.hstack([observer.A[:n, :n], np.zeros((n, self.h - n))]) + self.columns @ middle
        for row, (name, lag) in enumerate(lags[n:], n):
            self.following[row, lags.index((name, lag - 1))] = 1.0
        self.counted = np.flatnonzero(np.isfinite(scales.error))
        self.link = len(self.moving)
        late = self.delay * self.h + len(self.counted) if self.delay else 0
        self.sizes = (self.h + self.order + late, self.link * (self.delay + 1), n + q)
        self.q_rows = np.zeros((self.sizes[1], sum(self.sizes)))
        self.channels = [""] * self.sizes[1]

    def rows(self, where: int, first: int, count: int, scale: ArrayLike = 1.0) -> Array:
        """Return some entries of xi (0), p (1) or w (2)."""
        rows = np.zeros((count, sum(self.sizes)))
        rows[range(count), sum(self.sizes[:where]) + first + np.arange(count)] = scale
        return rows

    def predicted(self, e: Array, at: int) -> Array:
        """Return the next errors (h) without correction; the channels of their slopes begin at `at`."""
        late = f", {at // self.link} samples on" if self.link and at else ""
        functions = self.observer.lifting.functions + self.observer.lifting.input_functions
        after = self.following @ e
        for k, (i, j) in enumerate(self.moving, at):
            self.q_rows[k] = self.half[i, j] * e[j]
            self.channels[k] = f"{functions[i]} by {self.names[j]}{late}"
            after[: self.n] += np.outer(self.columns[:, i], self.rows(1, k, 1)[0])
        return after

    def system(self) -> ErrorSystem:
        """Return the error dynamics."""
        n, h, order, K = self.n, self.h, self.order, self.observer.controller
        e = self.rows(0, 0, h)
        after = self.predicted(e, 0)
        nu = e[list(self.observer.measured)] + self.rows(2, n, len(self.observer.measured), self.scales.noise)
        v = K.C @ self.rows(0, h, order) + K.D @ nu
        after[:n] -= self.into @ v
        following = self.late(after) if self.delay else [after]
        if not self.delay:
            after[:n] += self.rows(2, 0, n, self.scales.residual)
        following.insert(1, K.A @ self.rows(0, h, order) + K.B @ nu)
        (A, L, B), (M, E, D) = (
            np.split(rows, np.cumsum(self.sizes)[:-1], axis=1) for rows in (np.vstack(following), self.q_rows)
        )
        n_xi, shown = self.sizes[0], self.counted
        start, C = np.eye(n_xi, h), np.zeros((n, n_xi))
        places = n_xi - len(shown) + np.arange(len(shown)) if self.delay else shown
        C[shown, places] = 1 / self.scales.error[shown]
        if self.delay:
            start = np.zeros((n_xi, h))
            start[h + order : h + order + h] = np.eye(h)
            start[n_xi - len(shown) :, :n] = np.eye(n)[shown]
        return ErrorSystem(A, L, B, M, D, C, self.observer.sample_period_s, tuple(self.channels), E, start)

    def late(self, after: Array) -> list[Array]:
        """Return what follows with a delay: measured error, its residuals, latest first, and predicted error."""
        held = [self.rows(0, self.h * (i + 1) + self.order, self.h) for i in range(self.delay)]
        arriving = np.zeros((self.h, sum(self.sizes)))
        arriving[: self.n] = self.rows(2, 0, self.n, self.scales.residual)
        measured = ahead = after + held[-1]
        for i in range(1, self.delay + 1):
            ahead = self.predicted(ahead, i * self.link)
            ahead = ahead + (held[self.delay - 1 - i] if i < self.delay else arriving)
        return [measured, arriving, *held[:-1], ahead[self.counted]]


def state_sizes(observer: ObserverData, scales: ReliftScales, errors: Array) -> Array:
    """Return the sizes of xi, shape (n_xi,), from those of the errors, shape (n_window,)."""
    delay = observer.runtime.delay
    counted = errors[: len(scales.error)][np.isfinite(scales.error)]
    late = [*[errors] * delay, counted] if delay else []
    return np.concatenate([errors, np.ones(observer.controller.n_states), *late])


def slope_box(
    observer: ObserverData, names: Sequence[str], box: Box | None, parameters: Box | None
) -> tuple[Array, Array]:
    """Return bounds of the slopes of all functions by entries of the window, each (p + r, len(names))."""
    formulas = observer.lifting.formulas + observer.lifting.input_formulas
    ranges = {**(box or {}), **(parameters or {})}
    lower, upper = slope_bounds_of(formulas, names, ranges)
    unbounded = np.argwhere(~(np.isfinite(lower) & np.isfinite(upper)))
    if len(unbounded):
        i, j = unbounded[0]
        where = break_of(formulas[i].expression, ranges)
        problem = f"the slope of {formulas[i].text!r} by {names[j]!r} has no bound in the box {dict(box or {})}"
        remedy = "give a box: the ranges of the states and inputs it depends on"
        raise UnboundedSlopeError(f"{problem}{where and f', {where}'}; {remedy}")
    return lower, upper
