r"""A moving origin: the direction in which a machine can be moved without its observer noticing.

After a thousand turns the steps of single precision are coarser than an encoder's. Where all signals can be moved
together,

.. math:: (A_s - I)\, s_x + B\, s_u = 0, \qquad s_y = 1,

and the lifted functions repeat with a period P, an observer may run on ``x - o s_x``, ``y - o`` and ``u - o s_u`` with
an origin o that is a multiple of P: the same estimates, of small numbers. There are such directions for nearly every
model, since there are more signals than equations; the smallest one is taken. Generated code of
single precision runs so; double precision does without.
"""

from __future__ import annotations

from functools import lru_cache
from typing import Any

import numpy as np

from ...core import EPS, ITERATED, TINY, Array, frozen
from ...lifting import Lifting
from ...observer.data import ObserverData


@frozen
class ExportRule:
    """How the origin of single precision moves; estimates stay the same."""

    whole: float = 0.01  # factors as near to a whole number are whole: their difference is exact
    far: int = 8  # periods from the origin, as far as single precision goes
    rounding: float = 5e4 * EPS  # of the largest term of a direction
    periods: int = 60  # of the first function at most, until all others repeat
    static: float = 0.01  # of the largest measurement: the step of the origin where no function repeats


RULE = ExportRule()


@frozen
class OriginShift:
    """How an observer's signals move with the origin."""

    states: Array  # (n,)
    whole: Array  # (m,)
    rest: Array  # (m,)
    period: float


def find_shift(observer: ObserverData) -> OriginShift | None:
    """Return how the origin of an observer's one measurement can move; None where it cannot."""
    lifting = observer.lifting
    if len(observer.measured) != 1 or lifting.input_functions or lifting.history:
        return None
    at, n, m = observer.measured[0], lifting.n_states, len(observer.inputs)
    size = np.ones(n + m)
    if observer.seen is not None:
        size[[at, *range(n, n + m)]] = np.maximum(np.append(observer.seen.measured, observer.seen.inputs), TINY)
    moving = np.hstack([observer.A[:n, :n] - np.eye(n), observer.B[:n]])
    whole, rest = _direction(moving, at, n, size)
    if np.abs(moving @ (whole + rest)).max() > RULE.rounding * max(np.abs(moving * (whole + rest)).max(), TINY):
        return None
    others = frozenset(lifting.states[i] for i in range(n) if rest[i] != 0 and i != at)
    period = _period(lifting, lifting.states[at], others)
    if period is None:
        return None
    return OriginShift((whole + rest)[:n], whole[n:], rest[n:], period or RULE.static * float(size[at]))


def _direction(moving: Array, at: int, n: int, size: Array) -> tuple[Array, Array]:
    """Return the direction in which ``[A - I, B]`` moves nothing: whole numbers, and what is left."""
    free = np.arange(len(size)) != at
    whole, rest = np.eye(len(size))[at], np.zeros(len(size))
    for last in (False, True):
        rest[free] = np.linalg.lstsq((moving * size)[:, free], -moving @ whole, rcond=EPS * len(size))[0] * size[free]
        if not last:
            near = np.round(rest[n:])
            whole[n:] = np.where(np.abs(rest[n:] - near) < RULE.whole, near, 0.0)
    return whole, np.where(np.abs(rest) < RULE.rounding * size / size[at], 0.0, rest)


@lru_cache
def _period(lifting: Lifting, name: str, others: frozenset[str]) -> float | None:
    """Return the movement of a state after which all functions repeat; zero for any, None for none."""
    import sympy as sp

    symbol, rates = sp.Symbol(name, real=True), []
    for formula in lifting.formulas:
        if formula.used & others:
            return None
        circular = [f for f in formula.expression.atoms(sp.sin, sp.cos, sp.tan) if f.has(symbol)]
        if formula.expression.xreplace({f: sp.Dummy() for f in circular}).has(symbol):
            return None
        rates += [sp.diff(f.args[0], symbol) for f in circular]
    if any(not rate.is_number for rate in rates):
        return None
    return _common([abs(float(rate)) for rate in rates]) if rates else 0.0


def _common(rates: list[Any]) -> float | None:
    ratios = np.array(rates) / min(rates)
    for count in range(1, RULE.periods + 1):
        if np.abs(ratios * count - np.round(ratios * count)).max() < ITERATED:
            return float(2 * np.pi / min(rates) * count)
    return None
