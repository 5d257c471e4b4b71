"""Slopes of formulas over a box, and where a formula has none because it jumps or is not defined.

A derivative says nothing about a jump: that of ``atan(tan(x))`` is one wherever it exists. Bounds of the derivative are
bounds of the slope between any two points of the box where the formula is continuous on the box; that is decided here,
by intervals, on the formula itself. What intervals cannot decide counts as a jump.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from .intervals import Box, bounds_of, pieces_of

if TYPE_CHECKING:
    from .formula import Formula

Array = npt.NDArray[np.float64]
_NEAR = 1e-12  # relative to the interval: what rounding may hide


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
        whole = node.exp == int(node.exp)
        return (_not_zero if whole else _positive) if node.exp.is_negative else (None if whole else _not_negative)
    return _TESTS.get(type(node).__name__) if node.args and not node.is_number else None


def _slack(low: Array, high: Array) -> Array:
    size = np.maximum(np.abs(low), np.abs(high))
    return np.where(np.isfinite(size), _NEAR * size, 0.0)


def _not_zero(low: Array, high: Array) -> Any:
    return (low > _slack(low, high)) | (high < -_slack(low, high))


def _positive(low: Array, high: Array) -> Any:
    return low > _slack(low, high)


def _not_negative(low: Array, high: Array) -> Any:
    return low >= 0


def _between_poles(low: Array, high: Array) -> Any:
    slack = _slack(low, high) + _NEAR
    first, last = np.floor((low - slack) / np.pi + 0.5), np.floor((high + slack) / np.pi + 0.5)
    return np.isfinite(low) & np.isfinite(high) & (first == last)


_TESTS: Mapping[str, Any] = {"tan": _between_poles, "log": _positive, "sign": _not_zero}
