"""Bounds of values and slopes that hold everywhere in a box, by the interval arithmetic of mpmath.

Every operation rounds outwards. Where a quantity appears several times in a tree, the bounds of its intervals are wider
than its range: the piece of the box that decides is then cut in two, again and again. A box that reaches beyond the
domain of a root or a logarithm has no bounds.

A derivative says nothing about a jump: that of ``atan(tan(x))`` is one wherever it exists. Bounds of the derivative are
bounds of the slope between any two points of the box where the formula is continuous on the box; intervals decide that
on the formula itself, and what they cannot decide counts as a jump.
"""

from __future__ import annotations

import heapq
import operator
from collections import Counter
from collections.abc import Mapping, Sequence
from functools import lru_cache, reduce
from typing import Any

import numpy as np

from ..core import Array, ConfigError
from .formula import Formula, base_and_delay

Box = Mapping[str, Any]
Sides = dict[str, tuple[float, float]]
PIECES = 200  # of a box: a limit of the work, the bounds hold for any number


def bounds_of(expressions: Sequence[Any], box: Box) -> tuple[Array, Array]:
    """Return lower and upper bounds of expressions over a box, each of shape (len(expressions),)."""
    ends = np.array([_bounds(expression, box) for expression in expressions], dtype=float).reshape(-1, 2)
    return ends[:, 0], ends[:, 1]


def _bounds(expression: Any, box: Box) -> tuple[float, float]:
    import sympy as sp

    count = Counter(node.name for node in sp.preorder_traversal(expression) if node.is_Symbol)
    names = sorted(count)
    sides = {name: _range(name, box.get(name, box.get(base_and_delay(name)[0], (-np.inf, np.inf)))) for name in names}
    cut = [name for name in names if count[name] > 1 and 0 < sides[name][1] - sides[name][0] < np.inf]
    return _least(expression, sides, cut, 1), -_least(expression, sides, cut, -1)


def _range(name: str, value: Any) -> tuple[float, float]:
    low, high = map(float, np.broadcast_to(value, 2))
    if not low <= high:
        raise ConfigError(f"Bounds: the range of {name!r} is [{low:g}, {high:g}]; give the lower number first.")
    return low, high


def _least(expression: Any, sides: Sides, cut: Sequence[str], sign: int) -> float:
    """Return a lower bound of ``sign`` times a tree: of all pieces of the box, the one that decides is cut in two."""
    pieces: list[tuple[float, int, Sides]] = [(_ends(expression, sides)[sign], 0, sides)]
    for number in range(1, PIECES if cut else 0):
        least, _, worst = pieces[0]
        shares = {name: (worst[name][1] - worst[name][0]) / (sides[name][1] - sides[name][0]) for name in cut}
        name = max(cut, key=shares.__getitem__)
        if np.isinf(least) and shares[name] * PIECES < 1:
            break
        (low, high), middle = worst[name], sum(worst[name]) / 2
        left, right = (worst | {name: half} for half in ((low, middle), (middle, high)))
        heapq.heapreplace(pieces, (_ends(expression, left)[sign], -2 * number, left))
        heapq.heappush(pieces, (_ends(expression, right)[sign], -2 * number - 1, right))
    return pieces[0][0]


def _ends(expression: Any, sides: Sides) -> dict[int, float]:
    """Return lower bounds of a tree, 1, and of its negative, -1."""
    from mpmath import iv

    low, high = _doubles(_interval(expression, {name: iv.mpf(list(side)) for name, side in sides.items()}))
    return {1: low, -1: -high}


def _doubles(interval: Any) -> list[float]:
    """Return the ends of an interval, rounded outwards."""
    from mpmath import mpf

    a, b = mpf(interval.a), mpf(interval.b)
    low, high = float(a), float(b)
    low = float(np.nextafter(low, -np.inf)) if low > a else low
    return [low, float(np.nextafter(high, np.inf)) if high < b else high]


def _interval(expression: Any, values: Mapping[str, Any]) -> Any:
    """Return the interval of a tree; powers and exponentials end at doubles, larger ones take for ever."""
    import sympy as sp
    from mpmath import iv

    if expression.is_Symbol:
        return values[expression.name]
    if expression.is_number:
        return _number(expression)
    inner = [_interval(argument, values) for argument in expression.args]
    name = type(expression).__name__
    if name in ("exp", "Pow"):
        return iv.mpf(_doubles(_function(name, expression, inner)))
    if not isinstance(expression, sp.Add | sp.Mul):
        return _function(name, expression, inner)
    zero = _number(sp.S.Zero)
    if expression.is_Mul and any(x == zero for x in inner):  # zero times anything
        return zero
    return reduce(operator.add if isinstance(expression, sp.Add) else operator.mul, inner)


@lru_cache
def _number(expression: Any) -> Any:
    """Return the interval of a number."""
    import sympy as sp
    from mpmath import iv

    number = float(expression)
    exact = (expression.is_Rational or expression.is_Float) and sp.Rational(expression) == sp.Rational(number)
    return iv.mpf(number if exact else [np.nextafter(number, -np.inf), np.nextafter(number, np.inf)])


def _function(name: str, expression: Any, inner: Sequence[Any]) -> Any:
    """Return the interval of a function of intervals; all numbers where it is not real everywhere."""
    from mpmath import iv, libmp

    x, reals = inner[0], iv.mpf([-np.inf, np.inf])
    if name == "Pow" and expression.exp.is_number:
        whole = expression.exp == int(expression.exp)
        return x ** (int(expression.exp) if whole else inner[1]) if whole or x.a >= 0 else reals
    if name == "log":
        return iv.log(x) if x.a >= 0 else reals
    if name in ("sin", "cos", "tan", "exp"):
        return getattr(iv, name)(x)
    if name == "tanh":
        return 1 - 2 / (iv.exp(2 * x) + 1)
    if name == "atan":
        return iv.make_mpf(libmp.mpi_atan(x._mpi_, iv.prec))
    if name == "Abs":
        return abs(x)
    if name == "sign":
        return iv.mpf([np.sign(float(x.a)), np.sign(float(x.b))])
    if name == "DiracDelta":
        return iv.mpf([0, np.inf]) if x.a <= 0 <= x.b else iv.mpf(0)
    raise ConfigError(f"Bounds of {expression}: nothing is known about {name}.")


def slope_bounds_of(formulas: Sequence[Formula], names: Sequence[str], box: Box) -> tuple[Array, Array]:
    """Return bounds of the slopes between any two points of a box, each of shape (len(formulas), len(names))."""
    derivatives = [formula.derivative(name) for formula in formulas for name in names]
    lower, upper = (bound.reshape(len(formulas), len(names)) for bound in bounds_of(derivatives, box))
    for i, formula in enumerate(formulas):
        read = [name in formula.used for name in names]
        if any(read) and break_of(formula.expression, box):
            lower[i, read], upper[i, read] = -np.inf, np.inf
    return lower, upper


def break_of(expression: Any, box: Box) -> str:
    """Return in words where a tree may jump or be undefined on a box first; empty where it is continuous."""
    import sympy as sp

    for node in sp.preorder_traversal(expression):
        if node.args and not node.is_number and not _is_continuous(node, box):
            return f"{node} is not continuous, or not defined"
    return ""


def _is_continuous(node: Any, box: Box) -> bool:
    """Whether a node is continuous in its argument over all values that this takes in a box."""
    name = type(node).__name__
    if name not in ("tan", "log", "sign", "Pow"):
        return True
    low, high = _bounds(node.args[0], box)
    if name == "tan":
        return bool(np.isfinite([low, high]).all() and np.floor(low / np.pi + 0.5) == np.floor(high / np.pi + 0.5))
    if name == "Pow" and node.exp == int(node.exp):
        return not node.exp.is_negative or low > 0 or high < 0
    if name == "Pow" and not node.exp.is_negative:
        return low >= 0
    return low > 0 or (name == "sign" and high < 0)
