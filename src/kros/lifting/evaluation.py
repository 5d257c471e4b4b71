"""Vectorised evaluation of SymPy trees: nested closures over NumPy ufuncs, no code is generated.

A tree is split into its shape and its numbers. Trees of one shape, such as the ninety members of a family of radial basis functions, are
evaluated in one pass, their numbers along a last axis.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from ..core.errors import ConfigError

Array = npt.NDArray[np.float64]
Values = dict[Any, Any]  # arrays by name, and what was made of them on the way
Evaluator = Callable[[Values], Any]
Shape = tuple[Any, ...]

FUNCTIONS: dict[str, Callable[[Any], Any]] = {
    "sin": np.sin,
    "cos": np.cos,
    "tan": np.tan,
    "exp": np.exp,
    "log": np.log,
    "sqrt": np.sqrt,
    "tanh": np.tanh,
    "Abs": np.abs,
    "sign": np.sign,
    "atan": np.arctan,
}
_NUMBER: Shape = ("number",)
_POWERS: dict[float, Callable[[Any], Any]] = {
    -2.0: lambda base: 1.0 / (base * base),
    -1.0: lambda base: 1.0 / base,
    -0.5: lambda base: 1.0 / np.sqrt(base),
    0.5: np.sqrt,
    2.0: lambda base: base * base,
    3.0: lambda base: base * base * base,
}


@dataclass(frozen=True)
class ColumnEvaluator:
    """Expressions evaluated together, one column each."""

    singles: tuple[tuple[int, Evaluator], ...]  # columns whose shape no other has
    blocks: tuple[
        tuple[Any, Evaluator], ...
    ]  # columns of one shape; the evaluator wants values with a trailing axis of length one

    @classmethod
    def of(cls, expressions: Sequence[Any], first: int = 0) -> ColumnEvaluator:
        """Group expressions by shape; they go to the columns from `first` on."""
        groups: dict[Shape, list[tuple[int, list[float]]]] = {}
        for column, expression in enumerate(expressions, first):
            numbers: list[float] = []
            groups.setdefault(shape_of(expression, numbers), []).append((column, numbers))
        singles, blocks = [], []
        shared: dict[tuple[Shape, tuple[float, ...]], Evaluator] = {}
        for shape, members in groups.items():
            if len(members) == 1:
                singles.append((members[0][0], _assemble_sharing(shape, members[0][1], shared)))
            else:
                table = np.array([numbers for _, numbers in members]).T
                blocks.append((_as_slice([column for column, _ in members]), _assemble(shape, iter(table))))
        return cls(tuple(singles), tuple(blocks))

    def fill(self, values: Mapping[str, Array], out: Array) -> None:
        """Write the columns, along the last axis of `out`."""
        kept: Values = dict(values)
        for column, evaluator in self.singles:
            out[..., column] = evaluator(kept)
        if self.blocks:
            wide: Values = {name: value[..., None] for name, value in values.items()}
            for columns, evaluator in self.blocks:
                out[..., columns] = evaluator(wide)


def compile_expression(expression: Any) -> Evaluator:
    """Turn a SymPy tree into a function of a mapping from names to arrays."""
    numbers: list[float] = []
    return _assemble(shape_of(expression, numbers), iter(numbers))


def shape_of(expression: Any, numbers: list[float]) -> Shape:
    """Return the nested tuple that is left of a tree without its numbers, which are appended in its order."""
    import sympy as sp

    if expression.is_Symbol:
        return "symbol", expression.name
    if expression.is_number:
        numbers.append(_real(expression))
        return _NUMBER
    if isinstance(expression, sp.Add | sp.Mul):
        parts: list[tuple[Shape, list[float]]] = []
        for argument in expression.args:
            own: list[float] = []
            parts.append((shape_of(argument, own), own))
        parts.sort(key=lambda part: repr(part[0]))
        for _, own in parts:
            numbers.extend(own)
        return ("add" if isinstance(expression, sp.Add) else "multiply", *(shape for shape, _ in parts))
    if isinstance(expression, sp.Pow) and expression.exp.is_number:
        return "power", _real(expression.exp), shape_of(expression.base, numbers)
    name = type(expression).__name__
    if name == "DiracDelta":  # the slope of a sign is zero almost everywhere
        numbers.append(0.0)
        return _NUMBER
    if name not in FUNCTIONS:
        raise ConfigError(
            f"Formula node {expression!r}: no numerical evaluation is known; write the formula with {', '.join(sorted(FUNCTIONS))}."
        )
    return name, shape_of(expression.args[0], numbers)


def _real(number: Any) -> float:
    try:
        return float(number)
    except TypeError as error:
        raise ConfigError(
            f"Formula node {number!r}: is not a real number; keep roots and logarithms of positive quantities."
        ) from error


def _assemble(shape: Shape, numbers: Iterator[Any]) -> Evaluator:
    kind, *rest = shape
    if kind == "symbol":
        (name,) = rest
        return lambda values: values[name]
    if kind == "number":
        number = next(numbers)
        return lambda values: number
    if kind in ("add", "multiply"):
        return _fold(np.add if kind == "add" else np.multiply, [_assemble(child, numbers) for child in rest])
    if kind == "power":
        exponent, child = rest
        base = _assemble(child, numbers)
        power = _POWERS.get(exponent)
        if power is None:
            return lambda values: np.power(base(values), exponent)
        return lambda values: power(base(values))
    function, inner = FUNCTIONS[kind], _assemble(rest[0], numbers)
    return lambda values: function(inner(values))


def _assemble_sharing(
    shape: Shape, numbers: list[float], shared: dict[tuple[Shape, tuple[float, ...]], Evaluator]
) -> Evaluator:
    """Assemble a function whose argument others may have, too, such as sine and cosine of an angle: it is then evaluated once."""
    if shape[0] not in FUNCTIONS or shape[1][0] in ("symbol", "number"):
        return _assemble(shape, iter(numbers))
    key, function = (shape[1], tuple(numbers)), FUNCTIONS[shape[0]]
    if key not in shared:
        shared[key] = _once(_assemble(shape[1], iter(numbers)))
    inner = shared[key]
    return lambda values: function(inner(values))


def _once(evaluator: Evaluator) -> Evaluator:
    """Keep the result among the values that it was made of."""
    key = object()

    def evaluate(values: Values) -> Any:
        if key not in values:
            values[key] = evaluator(values)
        return values[key]

    return evaluate


def _fold(combine: Callable[[Any, Any], Any], children: list[Evaluator]) -> Evaluator:
    if len(children) == 2:
        left, right = children
        return lambda values: combine(left(values), right(values))
    first, *others = children

    def evaluate(values: Values) -> Any:
        result = first(values)
        for child in others:
            result = combine(result, child(values))
        return result

    return evaluate


def _as_slice(columns: list[int]) -> Any:
    """ColumnEvaluator as a slice where they follow each other, for a write without a gather."""
    start, stop = columns[0], columns[-1] + 1
    return slice(start, stop) if stop - start == len(columns) else np.array(columns)
