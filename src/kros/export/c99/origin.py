r"""A moving origin: the direction in which a machine can be moved without its observer noticing.

After a thousand turns the steps of single precision are coarser than an encoder's. Where all signals can be moved
together,

.. math:: (A_s - I)\, s_x + B\, s_u = 0, \qquad s_y = 1,

and the lifted functions repeat with a period P, an observer may run on ``x - o s_x``, ``y - o`` and ``u - o s_u`` with
an origin o that is a multiple of P: the same estimates, of small numbers. There are such directions for nearly every
model, since there are more signals than equations; the smallest one is taken. Generated code of either precision runs
so; double precision in Python does without.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import numpy as np
import numpy.typing as npt

from ...lifting import Lifting
from ...observer.data import ObserverData

Array = npt.NDArray[np.float64]
Long = npt.NDArray[np.longdouble]
FAR = 1024  # periods from the origin, as far as double precision goes
_EXACT, _NOTHING = 1e-11, 1e-13
_SAME = 1e-18  # nothing, in extended precision
_WHOLE = 0.01  # from a whole number, what is taken for one
_ROUNDS = 4  # each leaves a share of what the one before left that double precision's rounding is
_MOST = 64  # periods of the first function until all others repeat


@dataclass(frozen=True, eq=False)
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
    sizes = (
        np.ones(n + m)
        if observer.seen is None
        else np.concatenate([np.ones(n), np.maximum(observer.seen.inputs, 1e-300)])
    )
    if observer.seen is not None:
        sizes[at] = max(float(observer.seen.measured[0]), 1e-300)
    moving: Long = np.hstack([observer.A[:n, :n] - np.eye(n, dtype=np.longdouble), observer.B[:n]])
    whole, rest = _direction(moving, at, n, sizes)
    largest = float(np.abs(moving * (whole + rest)).max(initial=0.0))
    plain = np.where(np.abs(rest) < _NOTHING * sizes / sizes[at], 0.0, rest)
    for candidate, least in ((plain, _SAME), (rest, _EXACT), (plain, _EXACT)):
        if np.abs(moving @ whole + moving @ candidate).max() > least * max(largest, 1e-300):
            continue
        others = frozenset(lifting.states[i] for i in range(n) if candidate[i] != 0 and i != at)
        period = _period(lifting, lifting.states[at], others)
        if period is not None:
            return OriginShift((whole + candidate)[:n], whole[n:], candidate[n:], period or 0.01 * float(sizes[at]))
    return None


def _direction(moving: Long, at: int, n: int, sizes: Array) -> tuple[Array, Array]:
    """Return the direction in which ``[A - I, B]`` moves nothing: whole numbers, and what is left."""
    free = np.arange(len(sizes)) != at
    scaled = np.asarray(moving * sizes, dtype=float)[:, free]
    whole, rest = np.eye(len(sizes))[at], np.zeros(len(sizes))
    for step in range(_ROUNDS):
        left = np.asarray(moving @ whole + moving @ rest, dtype=float)
        rest[free] += np.linalg.lstsq(scaled, -left, rcond=1e-13)[0] * sizes[free]
        if step == 0:
            near = np.round(rest[n:])
            whole[n:], rest = np.where(np.abs(rest[n:] - near) < _WHOLE, near, 0.0), np.zeros(len(sizes))
    return whole, rest


@lru_cache(maxsize=64)
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
    for count in range(1, _MOST + 1):
        if np.abs(ratios * count - np.round(ratios * count)).max() < 1e-9:
            return float(2 * np.pi / min(rates) * count)
    return None
