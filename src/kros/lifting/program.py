"""Formulas as operations on numbered values, which NumPy and the compiled loops run and C is written from.

A program is data: no code is generated for a lifting, and what formulas have in common is computed once. The order of
operations is the same everywhere, so that results agree to rounding.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any

import numpy as np
import numpy.typing as npt

from ..core import Array, ByName, Names, frozen

Codes = npt.NDArray[np.int32]
Tree = tuple[Any, ...]
_NUMPY = {"Abs": "abs", "atan": "arctan"}
FUNCTIONS = ("sin", "cos", "tan", "exp", "log", "sqrt", "tanh", "Abs", "sign", "atan")
_KINDS = ("add", "multiply", "divide", "power", *FUNCTIONS)  # in the order of loops.c
_UFUNCS: list[np.ufunc] = [getattr(np, _NUMPY.get(kind, kind)) for kind in _KINDS]


@frozen
class Program:
    """Operations of some expressions; registers hold the quantities, then the constants, then results."""

    names: Names  # quantities
    constants: Array  # shape (constants,)
    code: Codes  # shape (operations, 4): kind, register of the result, registers of the two operands
    outputs: Codes  # register of every expression
    registers: int

    @classmethod
    def of(cls, expressions: Sequence[Any], names: Sequence[str] | None = None) -> Program:
        """Write SymPy trees of quantities, by default those that the trees name."""
        used = sorted({symbol.name for tree in expressions for symbol in tree.free_symbols})
        writer = Writer(used if names is None else list(names))
        return writer.finished([writer.write(tree_of(expression)) for expression in expressions])

    def run(self, values: ByName) -> list[Any]:
        """Return the values of the expressions for arrays by name, which broadcast against each other."""
        registers: list[Any] = [values[name] for name in self.names] + self.constants.tolist()
        registers += [None] * (self.registers - len(registers))
        for function, into, operands in self._steps:
            registers[into] = function(*(registers[i] for i in operands))
        return [registers[i] for i in self.outputs]

    def fill(self, out: Array, values: ByName) -> None:
        """Write the values of the expressions along the last axis."""
        for column, value in enumerate(self.run(values)):
            out[..., column] = value

    @cached_property
    def _steps(self) -> list[tuple[Callable[..., Any], int, tuple[int, ...]]]:
        rows = ((_UFUNCS[kind], into, operands) for kind, into, *operands in self.code.tolist())
        return [(function, into, tuple(operands[: function.nin])) for function, into, operands in rows]


@dataclass
class Writer:
    """Values are numbered as they come: quantities, then what is new; constants have negative numbers."""

    names: list[str]
    constants: list[float] = field(default_factory=list)
    operations: list[tuple[str, int, int]] = field(default_factory=list)
    known: dict[tuple[str, int, int], int] = field(default_factory=dict)

    def write(self, tree: Tree) -> int:
        """Return the value of a tree."""
        kind, *rest = tree
        if kind == "symbol":
            return self.names.index(rest[0])
        if kind == "number":
            return self._constant(rest[0])
        if kind == "power":
            return self._power(rest[0], self.write(rest[1]))
        first, *others = (self.write(child) for child in rest)
        if kind in FUNCTIONS:
            return self._do(kind, first, first)
        for other in others:
            first = self._do(kind, first, other)
        return first

    def _power(self, exponent: float, base: int) -> int:
        """Write powers that products, quotients and roots give exactly rounded as these."""
        if exponent < 0 and abs(exponent) in (0.5, 1.0, 2.0):
            return self._do("divide", self._constant(1.0), self._power(-exponent, base))
        if exponent == 0.5:
            return self._do("sqrt", base, base)
        if exponent not in (1.0, 2.0, 3.0):
            return self._do("power", base, self._constant(exponent))
        product = base
        for _ in range(int(exponent) - 1):
            product = self._do("multiply", product, base)
        return product

    def _constant(self, value: float) -> int:
        if value not in self.constants:
            self.constants.append(value)
        return -1 - self.constants.index(value)

    def _do(self, kind: str, first: int, second: int) -> int:
        operation = (kind, first, second)
        if operation not in self.known:
            self.known[operation] = len(self.names) + len(self.operations)
            self.operations.append(operation)
        return self.known[operation]

    def finished(self, outputs: Sequence[int]) -> Program:
        """Put values into registers."""
        given, constants = len(self.names), len(self.constants)
        order = [*range(given), *range(-1, -1 - constants, -1), *range(given, given + len(self.operations))]
        registers = {value: register for register, value in enumerate(order)}
        rows = [
            (_KINDS.index(kind), into, registers[first], registers[second])
            for into, (kind, first, second) in enumerate(self.operations, given + constants)
        ]
        code = np.array(rows, dtype=np.int32).reshape(-1, 4)
        places = np.array([registers[value] for value in outputs], dtype=np.int32)
        return Program(tuple(self.names), np.array(self.constants, dtype=float), code, places, len(order))


def tree_of(expression: Any) -> Tree:
    """Return kind and arguments of every node, those of sums and products ordered by their shape."""
    import sympy as sp

    if expression.is_Symbol:
        return "symbol", expression.name
    if expression.is_number:
        return "number", float(expression)
    if isinstance(expression, sp.Add | sp.Mul):
        children = sorted((tree_of(argument) for argument in expression.args), key=lambda tree: repr(_shape(tree)))
        return ("add" if isinstance(expression, sp.Add) else "multiply", *children)
    if isinstance(expression, sp.Pow) and expression.exp.is_number:
        return "power", float(expression.exp), tree_of(expression.base)
    name = type(expression).__name__
    if name == "DiracDelta":  # the slope of a sign is zero almost everywhere
        return "number", 0.0
    return name, tree_of(expression.args[0])


def _shape(tree: Tree) -> Tree:
    """Return a tree without its numbers: formulas that differ in these alone are computed in the same order."""
    kind, *rest = tree
    if kind in ("symbol", "number"):
        return tree if kind == "symbol" else ("number",)
    return (kind, *(_shape(part) if isinstance(part, tuple) else part for part in rest))


_SIGNS = {"add": "+", "multiply": "*", "divide": "/"}
_NAMES = {"Abs": "fabs"}


@dataclass(frozen=True)
class Precision:
    """How real numbers are written in C."""

    type: str = "double"  # ``double`` or ``float``

    @property
    def suffix(self) -> str:
        """What the names of functions in ``math.h`` end with."""
        return "f" if self.type == "float" else ""

    @property
    def largest(self) -> float:
        """Largest number."""
        return float(np.finfo(np.float32 if self.type == "float" else np.float64).max)

    def literal(self, value: float) -> str:
        """Return a literal that is read as the same number of this precision."""
        text = f"{np.float32(value):.9g}" if self.type == "float" else f"{float(value):.17g}"
        return (text if any(c in text for c in ".en") else f"{text}.0") + self.suffix


def c_code(expression: Any, name: Callable[[str], str], precision: Precision) -> str:
    """Return a SymPy tree as a C expression."""
    program, literal = Program.of([expression]), precision.literal
    numbers = map(literal, program.constants.tolist())
    texts = [*map(name, program.names), *(f"({text})" if text.startswith("-") else text for text in numbers)]
    for number, _, first, second in program.code.tolist():
        kind, x, other = _KINDS[number], texts[first], texts[second]
        if kind in _SIGNS:
            texts.append(f"({x} {_SIGNS[kind]} {other})")
        elif kind == "power":
            texts.append(f"pow{precision.suffix}({x}, {other})")
        elif kind == "sign":
            zero, one = literal(0.0), literal(1.0)
            texts.append(f"((({x}) > {zero}) ? {one} : ((({x}) < {zero}) ? -{one} : {zero}))")
        else:
            texts.append(f"{_NAMES.get(kind, kind)}{precision.suffix}({x})")
    return texts[program.outputs[0]]
