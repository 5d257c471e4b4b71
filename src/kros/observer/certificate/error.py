r"""The error of an observer that retracts and lifts its state at every step, as a linear system with slopes that move in a box.

            ┌──────────────────────────┐
     w ────►│ xi+ = A xi + L p + B w   ├────► z = C xi
       ┌───►│ q   = M xi + D w         ├───┐
     p │    └──────────────────────────┘   │ q
       └───────────── diag(d_k) ◄──────────┘            -1 <= d_k <= 1 in every entry, arbitrary from step to step

For a true trajectory ``x+ = f(x, u) + omega`` and measurements ``y = C x + n`` the error ``e = x - x_hat`` obeys this exactly (`docs/relift.md`
has the proof). A lifted function moves by ``sigma_i(x) - sigma_i(x_hat) = s_i' e`` with s_i its slope at a point between the two, hence in the
box of its slopes; the middle of the box goes into A, every entry that can move into a channel of its own.

Symbols
-------
xi        : [e, earlier errors that the lifting reads, x^c], the controller's states last
w, z      : [omega / residual, n / noise] and e / error, the scaled signals of `ReliftScales`
p, q      : what the slopes' movement adds, and what it acts on
d_k       : position of every slope in its interval
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import product
from typing import Any

import numpy as np
import numpy.typing as npt

from ...core.errors import DimensionError, KrosError
from ...core.lti import StateSpace
from ...lifting.continuity import break_of, slope_bounds_of
from ...lifting.formula import delayed_name
from ..data import ObserverData
from .status import Dropped

Array = npt.NDArray[np.float64]
Box = Mapping[str, Any]
_WIDER = 1 + 4 * np.finfo(float).eps  # centre and half width are rounded
_CONSTANT = 4e-12  # interval bounds are widened by 1e-12: a slope within that is constant


class UnboundedSlopeError(KrosError):
    """A lifted function may be arbitrarily steep where the observer may be."""


class UncoveredRuntimeError(KrosError):
    """An observer runs with what the equations of its error do not know."""


@dataclass(frozen=True, eq=False)
class ReliftScales:
    """Sizes that turn a gain into a statement: errors are divided by `error`, residuals and noise by theirs.

    Parameters
    ----------
    error : ndarray, shape (n,)
        Range of every state: a scaled error of 0.01 is one percent of the largest value. Infinite for a state whose error does not count.
    residual : ndarray, shape (n,)
        Size of the one-step residual in every state; zero for a state without.
    noise : ndarray, shape (q,)
        Size of every measurement's noise.
    """

    error: Array
    residual: Array
    noise: Array

    def __post_init__(self) -> None:
        for name in ("error", "residual", "noise"):
            values = np.atleast_1d(np.asarray(getattr(self, name), dtype=float))
            object.__setattr__(self, name, values)
            sized = (
                np.all(values > 0) and np.isfinite(values).any() if name == "error" else np.isfinite(values).all() and np.all(values >= 0)
            )
            if not sized:
                raise DimensionError(f"Re-lift scales: {name} should be finite sizes above zero, found {values}.")

    @classmethod
    def typical(cls, ranges: npt.ArrayLike, residual: Array, noise: npt.ArrayLike) -> ReliftScales:
        """Return the scales for which a population's residual has unit power: its gain then *is* the error that is certified on a typical unit.

        Of ranges, shape (n,), one-step residuals of the population, shape (..., n), and the standard deviation of every measurement's noise, shape (q,).
        """
        n, sigma = residual.shape[-1], np.atleast_1d(np.asarray(noise, dtype=float))
        rms = np.sqrt(np.mean(residual.reshape(-1, n) ** 2, axis=0))
        return cls(np.asarray(ranges, dtype=float), rms * np.sqrt(n), sigma * np.sqrt(len(sigma)))

    def with_internal(self, count: int) -> ReliftScales:
        """Return the scales for an observer with so many internal states: they have no residual, and their errors do not count."""
        return ReliftScales(np.append(self.error, np.full(count, np.inf)), np.append(self.residual, np.zeros(count)), self.noise)

    @classmethod
    def ones(cls, observer: ObserverData) -> ReliftScales:
        """Return the scales that change nothing."""
        n = len(observer.recorded)
        return cls(np.ones(n), np.ones(n), np.ones(len(observer.measured))).with_internal(observer.lifting.n_states - n)


@dataclass(frozen=True, eq=False)
class ErrorSystem:
    """Linear part of the error dynamics with its channels, as drawn above.

    Parameters
    ----------
    A, L, B : ndarray, shape (n_xi, n_xi), (n_xi, n_p), (n_xi, n_w)
    M, D : ndarray, shape (n_p, n_xi), (n_p, n_w)
    C : ndarray, shape (n_z, n_xi)
    dt : float, s
    channels : tuple of str
        What moves in every channel, for people.
    """

    A: Array
    L: Array
    B: Array
    M: Array
    D: Array
    C: Array
    dt: float
    channels: tuple[str, ...] = ()

    @property
    def corner_count(self) -> int:
        """Number of corners of the box."""
        return int(2 ** self.L.shape[1])

    def corner(self, d: npt.ArrayLike) -> tuple[Array, Array]:
        """Return ``A + L diag(d) M`` and ``B + L diag(d) D`` for slopes at a place in the box, shape (n_p,)."""
        moved = self.L * np.asarray(d, dtype=float)
        return self.A + moved @ self.M, self.B + moved @ self.D

    def corners(self) -> list[tuple[Array, Array]]:
        """Return the pairs of all corners."""
        return [self.corner(d) for d in product((-1.0, 1.0), repeat=self.L.shape[1])]

    def multiplied(self, multipliers: Array, gain: float) -> tuple[tuple[Array, Array], Array, Array]:
        """Return (A, B), C and D with p as an input and q as an output, scaled by multipliers: a gain proven for it holds in the whole box."""
        root = np.sqrt(multipliers)
        B = np.hstack([self.L / root * gain, self.B])
        C = np.vstack([_WIDER * root[:, None] * self.M, self.C])
        D = np.zeros((len(C), B.shape[1]))
        D[: len(root), len(root) :] = _WIDER * root[:, None] * self.D
        return (self.A, B), C, D

    def frozen(self, d: npt.ArrayLike) -> StateSpace:
        """Return the system from w to z with slopes that stay where they are."""
        A, B = self.corner(d)
        return StateSpace(A, B, self.C, np.zeros((len(self.C), B.shape[1])), self.dt)

    def mismatch(self) -> ErrorSystem:
        """Return the system from ``q`` of the frozen response to the rest of the error.

        With the frozen response ``xi_0+ = A xi_0 + B w`` the rest obeys ``r+ = (A + L d M) r + L d q_0``, ``q_0 = M xi_0``, from zero.
        """
        width = self.L.shape[1]
        return replace(self, B=np.zeros((len(self.A), width)), D=np.eye(width))


def error_system(
    observer: ObserverData,
    scales: ReliftScales | None = None,
    box: Box | None = None,
    parameters: Box | None = None,
    *,
    clipped: bool = False,
) -> ErrorSystem:
    """Return the error dynamics of an observer as it runs; arguments as in `relift_certificate`.

    Raises
    ------
    UnboundedSlopeError
        When a slope is unbounded in the box; name ranges of the states it depends on.
    UncoveredRuntimeError
        When the observer runs with a delay or limits.
    """
    require_covered(observer)
    scales = scales or ReliftScales.ones(observer)
    lifting, K, q = observer.lifting, observer.controller, len(observer.measured)
    n = lifting.n_states
    if (scales.error.shape, scales.residual.shape, scales.noise.shape) != ((n,), (n,), (q,)):
        raise DimensionError(
            f"Re-lift scales of observer {observer.name}: needs {n} errors, {n} residuals and {q} noises, found {scales.error.shape}, "
            f"{scales.residual.shape}, {scales.noise.shape}."
        )
    lags = [(name, delay) for name, delay in lifting.window.quantities if name in lifting.states]
    names = [delayed_name(name, d) for name, d in lags]
    lower, upper = slope_box(observer, names, box, parameters, clipped=clipped)
    columns = np.hstack([observer.A[:n, n:], observer.B[:n, len(observer.inputs) :]])
    functions = lifting.functions + lifting.input_functions
    middle, half = (lower + upper) / 2, (upper - lower) / 2 * _WIDER

    h, order = len(names), K.n_states
    selector = np.eye(n, h)[list(observer.measured)]
    into = observer.into[:n]
    A = np.zeros((h + order, h + order))
    A[:n, :n] = observer.A[:n, :n]
    A[:n, :h] += columns @ middle - into @ K.D @ selector
    for row, (name, d) in enumerate(lags[n:], n):
        A[row, lags.index((name, d - 1))] = 1.0
    A[:n, h:], A[h:, :h], A[h:, h:] = -into @ K.C, K.B @ selector, K.A
    B = np.zeros((h + order, n + q))
    B[:n, :n], B[:n, n:], B[h:, n:] = np.diag(scales.residual), -into @ K.D * scales.noise, K.B * scales.noise
    moving = np.argwhere((half > _CONSTANT * np.abs(middle)) & np.any(columns, axis=0)[:, None])
    L, M = np.zeros((h + order, len(moving))), np.zeros((len(moving), h + order))
    for channel, (i, j) in enumerate(moving):
        L[:n, channel], M[channel, j] = columns[:, i], half[i, j]
    C = np.zeros((n, h + order))
    C[:, :n] = np.diag(1 / scales.error)
    channels = tuple(f"{functions[i]} by {names[j]}" for i, j in moving)
    return ErrorSystem(A, L, B, M, np.zeros((len(moving), n + q)), C, observer.sample_period_s, channels)


def require_covered(observer: ObserverData) -> None:
    """Refuse an observer whose `runtime` changes what runs: the error then obeys other equations than those that are certified."""
    if declared := observer.runtime.changes:
        raise UncoveredRuntimeError(
            f"observer {observer.name} runs with {', '.join(declared)}, which the error equations do not cover; "
            "certify it without, and do not take that certificate for one of the observer as declared"
        )


def slope_box(
    observer: ObserverData, names: Sequence[str], box: Box | None = None, parameters: Box | None = None, *, clipped: bool = False
) -> tuple[Array, Array]:
    """Return bounds of the slopes of lifted and input functions by some entries of the window, each of shape (p + r, len(names)).

    Earlier inputs are not among the names: machine and observer have the same ones.
    """
    formulas = observer.lifting.formulas + observer.lifting.input_formulas
    ranges = {**(box or {}), **(parameters or {})}
    lower, upper = slope_bounds_of(formulas, names, ranges)
    unbounded = np.argwhere(~(np.isfinite(lower) & np.isfinite(upper)))
    if len(unbounded):
        i, j = unbounded[0]
        raise UnboundedSlopeError(
            f"the slope of {formulas[i].text!r} by {names[j]!r} has no bound"
            + (f" in the box {dict(box)}" if box else "")
            + (f", {where}" if (where := break_of(formulas[i].expression, ranges)) else "")
            + "; give a box: the ranges of the states and inputs it depends on"
        )
    return (np.minimum(lower, 0.0), np.maximum(upper, 0.0)) if clipped else (lower, upper)


def without_measurement(observer: ObserverData, system: ErrorSystem, dropped: Dropped) -> list[ErrorSystem]:
    """Return the dynamics of a step whose measurement is missing, one system for each thing that the observer may do then."""
    K, n, q = observer.controller, observer.lifting.n_states, len(observer.measured)
    h = len(system.A) - K.n_states
    into = observer.into[:n]
    A, B = system.A.copy(), system.B.copy()
    A[:n, list(observer.measured)] += into @ K.D
    A[h:, :h] = 0.0
    B[:, -q:] = 0.0
    withheld = A.copy()
    withheld[:n, h:] = 0.0
    steps = {Dropped.NEVER: [], Dropped.INNOVATION: [A], Dropped.CORRECTION: [withheld], Dropped.EITHER: [A, withheld]}
    return [replace(system, A=step, B=B) for step in steps[dropped]]
