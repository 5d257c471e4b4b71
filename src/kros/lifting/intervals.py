"""Interval arithmetic on SymPy trees: bounds of values and slopes that hold everywhere in a box.

Intervals are pairs of arrays, one entry a piece of the box: the box is cut along its finite sides, and the bounds of a
tree are the union over the pieces, which makes them tight where a quantity appears several times. Every operation
rounds outwards. A box that reaches beyond the domain of a root or a logarithm has no bounds.

A derivative says nothing about a jump: that of ``atan(tan(x))`` is one wherever it exists. Bounds of the derivative are
bounds of the slope between any two points of the box where the formula is continuous on the box; intervals decide that
on the formula itself, and what they cannot decide counts as a jump.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np
import numpy.typing as npt

from ..core.errors import ConfigError
from .formula import Formula, base_and_delay

Array = npt.NDArray[np.float64]
Interval = tuple[Array, Array]
Box = Mapping[str, Any]

PIECES = 4096  # of a box: a limit of the work, the bounds hold for any number
_EPSILON, _TINY = float(np.finfo(float).eps), float(np.finfo(float).tiny)
_ULPS = 4.0  # within which elementary functions are computed
_NEAR = 4500 * _EPSILON  # relative to an interval: what rounding may hide of a pole
_REALS = (-np.inf, np.inf)


def bounds_of(expressions: Sequence[Any], box: Box) -> tuple[Array, Array]:
    """Return lower and upper bounds of expressions over a box, each of shape (len(expressions),)."""
    with np.errstate(all="ignore"):
        pieces = [pieces_of(expression, box) for expression in expressions]
    return np.array([np.min(low) for low, _ in pieces]), np.array([np.max(high) for _, high in pieces])


def _range(name: str, value: Any) -> tuple[float, float]:
    low, high = (float(v) for v in (value if np.ndim(value) else (value, value)))
    if not low <= high:
        raise ConfigError(f"Bounds: the range of {name!r} is [{low:g}, {high:g}]; give the lower number first.")
    return low, high


def pieces_of(expression: Any, box: Box) -> Interval:
    """Return bounds of a tree over every piece of a box, each of shape (pieces,)."""
    names = sorted(symbol.name for symbol in expression.free_symbols)
    sides = {name: _range(name, box.get(name, box.get(base_and_delay(name)[0], _REALS))) for name in names}
    return _walk(expression, _pieces(sides))


def _pieces(sides: Mapping[str, tuple[float, float]]) -> dict[str, Interval]:
    """Cut a box along its finite sides; entries of the result have the shape (pieces,)."""
    finite = [name for name, (low, high) in sides.items() if np.isfinite([low, high]).all() and low < high]
    count = max(2, int(PIECES ** (1 / len(finite)))) if 0 < len(finite) <= np.log2(PIECES) else 1
    grid = dict(zip(finite, np.indices((count,) * len(finite)).reshape(len(finite), count ** len(finite)), strict=True))
    pieces: dict[str, Interval] = {}
    for name, (low, high) in sides.items():
        edges, cell = np.linspace(low, high, count + 1), grid.get(name)
        pieces[name] = (np.full(1, low), np.full(1, high)) if cell is None else (edges[cell], edges[cell + 1])
    return pieces


def _walk(expression: Any, values: Mapping[str, Interval]) -> Interval:
    import sympy as sp

    if expression.is_Symbol:
        return values[expression.name]
    if expression.is_number:
        number = np.full(1, float(expression))
        return (number, number) if expression == float(expression) else _outward(number, number)
    if isinstance(expression, sp.Add | sp.Mul):
        combine = _add if isinstance(expression, sp.Add) else _multiply
        result, *rest = (_walk(argument, values) for argument in expression.args)
        for other in rest:
            result = combine(result, other)
        return result
    if isinstance(expression, sp.Pow) and expression.exp.is_number:
        return _power(_walk(expression.base, values), expression.exp)
    function = _FUNCTIONS.get(type(expression).__name__)
    if function is None:
        raise ConfigError(f"Bounds of {expression}: nothing is known about {type(expression).__name__}.")
    return function(*_walk(expression.args[0], values))


def _outward(low: Array, high: Array, ulps: float = 1.0) -> Interval:
    """Widen bounds by what rounding may have changed; a result of zero is exact, or is given apart."""
    slack = ulps * np.spacing(np.maximum(np.abs(low), 1e-300)), ulps * np.spacing(np.maximum(np.abs(high), 1e-300))
    below = np.where(np.isposinf(low), np.finfo(float).max, np.where(np.isfinite(low), low - slack[0], low))
    above = np.where(np.isneginf(high), -np.finfo(float).max, np.where(np.isfinite(high), high + slack[1], high))
    return np.where(low == 0, 0.0, below), np.where(high == 0, 0.0, above)


def _add(a: Interval, b: Interval) -> Interval:
    low, high = _outward(a[0] + b[0], a[1] + b[1])  # inf - inf has no bound
    return np.where(np.isnan(low), -np.inf, low), np.where(np.isnan(high), np.inf, high)


def _multiply(a: Interval, b: Interval) -> Interval:
    products = [_ends(x * y, np.sign(x) * np.sign(y)) for x in a for y in b]
    return _outward(np.minimum.reduce([low for low, _ in products]), np.maximum.reduce([high for _, high in products]))


def _ends(value: Array, sign: Array) -> Interval:
    """Bounds of a product: what has underflowed is below the smallest normal number, zero times anything is zero."""
    tiny, value = np.abs(value) < _TINY, np.where(sign == 0, 0.0, value)
    return np.where(tiny, np.minimum(sign, 0.0) * _TINY, value), np.where(tiny, np.maximum(sign, 0.0) * _TINY, value)


def _power(base: Interval, exponent: Any) -> Interval:
    if exponent.is_negative:
        return _reciprocal(_power(base, -exponent))
    low, high = base
    if exponent == int(exponent):
        n = int(exponent)
        (low_a, high_a), (low_b, high_b) = (_ends(side**n, np.sign(side) ** n) for side in base)
        if n % 2:
            return _outward(low_a, high_b, _ULPS)
        lower, upper = _outward(np.minimum(low_a, low_b), np.maximum(high_a, high_b), _ULPS)
        return np.where((low <= 0) & (high >= 0), 0.0, lower), upper
    p = float(exponent)
    return _where_defined(low >= 0, *_outward(np.maximum(low, 0.0) ** p, np.maximum(high, 0.0) ** p, _ULPS))


def _reciprocal(a: Interval) -> Interval:
    low, high = a
    through = (low < 0) & (high > 0)
    lower = np.where(through | (high == 0), -np.inf, 1 / np.where(high == 0, 1.0, high))
    upper = np.where(through | (low == 0), np.inf, 1 / np.where(low == 0, 1.0, low))
    return _outward(*_where_defined((low != 0) | (high != 0), lower, upper))


def _where_defined(defined: npt.NDArray[np.bool_], low: Array, high: Array) -> Interval:
    return np.where(defined, low, -np.inf), np.where(defined, high, np.inf)


def _sine(low: Array, high: Array) -> Interval:
    def touches(phase: float) -> npt.NDArray[np.bool_]:
        """Whether the interval holds phase + 2 pi k for some k, by more than rounding."""
        slack = _ULPS * _EPSILON * (np.abs(low) + np.abs(high) + 1)
        turns = np.floor((high + slack - phase) / (2 * np.pi))
        return ~(turns < np.ceil((low - slack - phase) / (2 * np.pi)))

    ends = np.sin(np.where(np.isfinite(low), low, 0.0)), np.sin(np.where(np.isfinite(high), high, 0.0))
    endless = ~(np.isfinite(low) & np.isfinite(high))
    slack = _ULPS * _EPSILON * (1 + np.maximum(np.abs(low), np.abs(high)))  # of the argument too, which may be shifted
    return (
        np.where(endless | touches(-np.pi / 2), -1.0, np.maximum(np.minimum(*ends) - slack, -1.0)),
        np.where(endless | touches(np.pi / 2), 1.0, np.minimum(np.maximum(*ends) + slack, 1.0)),
    )


def _tangent(low: Array, high: Array) -> Interval:
    branch = np.floor(low / np.pi + 0.5), np.floor(high / np.pi + 0.5)
    inside = (branch[0] == branch[1]) & np.isfinite(low) & np.isfinite(high) & (np.tan(low) <= np.tan(high))
    return _where_defined(inside, *_outward(np.tan(low), np.tan(high), _ULPS))


def _logarithm(low: Array, high: Array) -> Interval:
    below, above = _outward(np.log(np.maximum(low, 0.0)), np.log(np.maximum(high, 0.0)), _ULPS)
    return _where_defined(low >= 0, below, np.where(high == 0, -np.inf, above))


def _magnitude(low: Array, high: Array) -> Interval:
    small, large = np.sort(np.abs([low, high]), axis=0)
    return np.where((low <= 0) & (high >= 0), 0.0, small), large


def _rising(
    function: Callable[[Array], Array], least: float = -np.inf, most: float = np.inf
) -> Callable[[Array, Array], Interval]:
    """Bounds of a rising function, whose values are known to lie between two numbers."""

    def bounds(low: Array, high: Array) -> Interval:
        below, above = _outward(function(low), function(high), _ULPS)
        return np.maximum(below, least), np.minimum(above, most)

    return bounds


_FUNCTIONS: dict[str, Callable[[Array, Array], Interval]] = {
    "sin": _sine,
    "cos": lambda low, high: _sine(low + np.pi / 2, high + np.pi / 2),
    "tan": _tangent,
    "exp": lambda low, high: (_rising(np.exp, 0.0)(low, low)[0], np.maximum(_rising(np.exp)(high, high)[1], _TINY)),
    "log": _logarithm,
    "tanh": _rising(np.tanh, -1.0, 1.0),
    "atan": _rising(np.arctan),
    "sign": lambda low, high: (np.sign(low), np.sign(high)),
    "Abs": _magnitude,
    "DiracDelta": lambda low, high: (np.zeros_like(low), np.where((low <= 0) & (high >= 0), np.inf, 0.0)),
}


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
        test = _breaks(node)
        if test is not None:
            with np.errstate(all="ignore"):
                low, high = pieces_of(node.args[0], box)
                if not np.all(test(low, high)):
                    return f"{node} is not continuous, or not defined"
    return ""


def _breaks(node: Any) -> Any:
    """Return the test that intervals of a node's argument have to pass; None where it is continuous everywhere."""
    import sympy as sp

    if isinstance(node, sp.Pow) and node.exp.is_number and not node.base.is_number:
        whole, negative = bool(node.exp == int(node.exp)), bool(node.exp.is_negative)
        kinds = {(True, True): "sign", (False, True): "log", (False, False): "root"}
        return _TESTS.get(kinds.get((whole, negative), ""))
    return _TESTS.get(type(node).__name__) if node.args and not node.is_number else None


def _slack(low: Array, high: Array) -> Array:
    size = np.maximum(np.abs(low), np.abs(high))
    return np.where(np.isfinite(size), _NEAR * size, 0.0)


def _not_zero(low: Array, high: Array) -> Any:
    return (low > _slack(low, high)) | (high < -_slack(low, high))


def _between_poles(low: Array, high: Array) -> Any:
    slack = _slack(low, high) + _NEAR
    first, last = np.floor((low - slack) / np.pi + 0.5), np.floor((high + slack) / np.pi + 0.5)
    return np.isfinite(low) & np.isfinite(high) & (first == last)


_TESTS: Mapping[str, Any] = {
    "tan": _between_poles,
    "log": lambda low, high: low > _slack(low, high),
    "sign": _not_zero,
    "root": lambda low, high: low >= 0,
}
