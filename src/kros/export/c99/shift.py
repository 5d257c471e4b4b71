r"""A moving origin: the direction in which a machine can be moved without its observer noticing.

A single-precision number holds seven digits: after a thousand turns its steps are coarser than an encoder's. Where all signals can be moved together,

.. math:: (A_s - I)\, s_x + B\, s_u = 0, \qquad s_y = 1,

and the lifted functions repeat with a period P, an observer may run on ``x - o s_x``, ``y - o`` and ``u - o s_u`` with an origin o that is a multiple of
P: the same estimates, of small numbers. There are such directions for nearly every model, since there are more signals than equations; the smallest
one is taken.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from ...observer import Observer

Array = npt.NDArray[np.float64]
_EXACT, _NOTHING = 1e-11, 1e-13
_MOST = 64  # periods of the first function until all others repeat


@dataclass(frozen=True, eq=False)
class Shift:
    """How an observer's signals move with the origin.

    Parameters
    ----------
    states : ndarray, shape (n,)
        Movement of the states for an origin moved by one.
    inputs : ndarray, shape (m,)
    period : float
        The origin moves in multiples of it.
    """

    states: Array
    inputs: Array
    period: float


def find_shift(observer: Observer) -> Shift | None:
    """Return how the origin of an observer's one measurement can move; None where it cannot."""
    lifting = observer.lifting
    if len(observer.measured) != 1 or lifting.input_functions or lifting.history:
        return None
    at, n, m = observer.measured[0], lifting.n_states, len(observer.inputs)
    sizes = np.ones(n + m) if observer.seen is None else np.concatenate([np.ones(n), np.maximum(observer.seen.inputs, 1e-300)])
    if observer.seen is not None:
        sizes[at] = max(float(observer.seen.measured[0]), 1e-300)
    moving = np.hstack([observer.A[:n, :n] - np.eye(n), observer.B[:n]])
    free = [i for i in range(n + m) if i != at]
    found, *_ = np.linalg.lstsq(moving[:, free] * sizes[free], -moving[:, at], rcond=1e-13)
    direction = np.zeros(n + m)
    direction[at], direction[free] = 1.0, found * sizes[free]
    reads = {lifting.states[i] for i in range(n) if direction[i] != 0}
    period = _period(observer, lifting.states[at], reads, 0.01 * sizes[at])
    plain = np.where(np.abs(direction) < _NOTHING * sizes / sizes[at], 0.0, direction)
    largest = float(np.abs(moving * direction).max(initial=0.0))
    direction = plain if np.abs(moving @ plain).max() <= _EXACT * max(largest, 1e-300) else direction
    if period is None or np.abs(moving @ direction).max() > _EXACT * max(largest, 1e-300):
        return None
    return Shift(direction[:n], direction[n:], period)


def _period(observer: Observer, name: str, moving: set[str], otherwise: float) -> float | None:
    """Return the movement of one state after which all lifted functions are what they were; None where there is none.

    Without functions of it any movement will do: `otherwise`.
    """
    import sympy as sp

    symbol, rates = sp.Symbol(name, real=True), []
    for formula in observer.lifting.formulas:
        if formula.used & (moving - {name}):
            return None
        circular = [f for f in formula.expression.atoms(sp.sin, sp.cos, sp.tan) if f.has(symbol)]
        if formula.expression.xreplace({f: sp.Dummy() for f in circular}).has(symbol):
            return None
        rates += [sp.diff(f.args[0], symbol) for f in circular]
    if any(not rate.is_number for rate in rates):
        return None
    return _common([abs(float(rate)) for rate in rates]) if rates else otherwise


def _common(rates: list[Any]) -> float | None:
    ratios = np.array(rates) / min(rates)
    for count in range(1, _MOST + 1):
        if np.abs(ratios * count - np.round(ratios * count)).max() < 1e-9:
            return float(2 * np.pi / min(rates) * count)
    return None
