"""Formulas of a lifting as a tape: operations on registers, one after the other, in the order in which `kros.lifting` evaluates them.

A tape is data: no code is generated for a lifting, and nothing compiled for it. What formulas have in common is computed once.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from functools import lru_cache
from typing import Any

import numpy as np
import numpy.typing as npt

from ..lifting import Lifting
from ..lifting.evaluation import shape_of

Whole = npt.NDArray[np.int32]
_KINDS = (
    "add",
    "multiply",
    "divide",
    "power",
    "sin",
    "cos",
    "tan",
    "exp",
    "log",
    "sqrt",
    "tanh",
    "Abs",
    "sign",
    "atan",
)  # as in loops.c
_POWERS: dict[float, tuple[int, bool, bool]] = {
    -2.0: (2, True, False),
    -1.0: (1, True, False),
    -0.5: (1, True, True),
    0.5: (1, False, True),
} | {
    2.0: (2, False, False),
    3.0: (3, False, False),
}  # factors, whether their product divides one, and whether its root is meant


@dataclass(frozen=True, eq=False)
class Tape:
    """Operations of a lifting."""

    constants: npt.NDArray[np.float64]  # shape (constants,)
    code: Whole  # shape (operations, 4); What is done, the register that it goes into, and those it is done with
    lifted: Whole  # shape (n_lifted + inputs,); Registers of the lifted states, then of the inputs and their functions
    slopes: Whole  # shape (slopes, 3); Column of a model, entry among those asked for, and register, of every derivative that is not zero
    registers: int


@lru_cache(maxsize=64)
def tape_of(lifting: Lifting, m: int, entries: tuple[int, ...] = (), of_inputs: bool = True) -> Tape:
    """Return the tape of a lifting with m recorded inputs."""
    window, n_lifted = lifting.window.names, lifting.n_lifted
    inputs = lifting.inputs or tuple(f"input {i}" for i in range(m))  # which no formula can read
    writer = _TapeWriter([*window, *inputs, *lifting.parameters])
    functions = [writer.write(formula.expression) for formula in lifting.formulas]
    of = [writer.write(formula.expression) for formula in lifting.input_formulas]
    states = list(range(lifting.n_states))
    lifted = [*states, *functions, *range(len(window), len(window) + m), *of]
    formulas = [(lifting.n_states + i, formula) for i, formula in enumerate(lifting.formulas)]
    formulas += [(n_lifted + m + i, formula) for i, formula in enumerate(lifting.input_formulas)] if of_inputs else []
    slopes = [
        (column, place, formula.derivative(window[entry]))
        for column, formula in formulas
        for place, entry in enumerate(entries)
    ]
    written = [(column, place, writer.write(tree)) for column, place, tree in slopes if tree != 0]
    return writer.finished(lifted, written)


@dataclass
class _TapeWriter:
    """Values are numbered as they come: quantities, then whatever is new; constants have negative numbers until all are known."""

    names: list[str]
    constants: list[float] = field(default_factory=list)
    operations: list[tuple[int, int, int]] = field(default_factory=list)
    known: dict[tuple[int, int, int], int] = field(default_factory=dict)

    def write(self, expression: Any) -> int:
        """Return the value of a SymPy tree."""
        numbers: list[float] = []
        return self._write(shape_of(expression, numbers), iter(numbers))

    def _write(self, shape: Any, numbers: Iterator[float]) -> int:
        kind, *rest = shape
        if kind == "symbol":
            return self.names.index(rest[0])
        if kind == "number":
            return self._constant(next(numbers))
        if kind == "power":
            return self._power(rest[0], self._write(rest[1], numbers))
        first, *others = (self._write(child, numbers) for child in rest)
        if kind not in ("add", "multiply"):
            return self._do(kind, first, first)
        for other in others:
            first = self._do(kind, first, other)
        return first

    def _power(self, exponent: float, base: int) -> int:
        if exponent not in _POWERS:
            return self._do("power", base, self._constant(exponent))
        factors, divides, root = _POWERS[exponent]
        found = self._do("sqrt", base, base) if root else base
        for _ in range(factors - 1):
            found = self._do("multiply", found, base)
        return self._do("divide", self._constant(1.0), found) if divides else found

    def _constant(self, value: float) -> int:
        if value not in self.constants:
            self.constants.append(value)
        return -1 - self.constants.index(value)

    def _do(self, kind: str, first: int, second: int) -> int:
        operation = (_KINDS.index(kind), first, second)
        if operation not in self.known:
            self.known[operation] = len(self.names) + len(self.operations)
            self.operations.append(operation)
        return self.known[operation]

    def finished(self, lifted: Sequence[int], slopes: Sequence[tuple[int, int, int]]) -> Tape:
        """Put values into registers; one that nothing reads any more is used again."""
        given = len(self.names)
        registers = {value: value for value in range(given)} | {-1 - i: given + i for i in range(len(self.constants))}
        kept = {*lifted, *(value for _, _, value in slopes), *registers}
        last = {value: i for i, (_, first, second) in enumerate(self.operations) for value in (first, second)}
        free: list[int] = []
        count, code = len(registers), np.zeros((len(self.operations), 4), dtype=np.int32)
        for i, (kind, first, second) in enumerate(self.operations):
            places = registers[first], registers[second]
            free += [registers[value] for value in {first, second} if last[value] == i and value not in kept]
            if free:
                into = free.pop()
            else:
                into, count = count, count + 1
            registers[given + i], code[i] = into, (kind, into, *places)
        places_of = [(column, place, registers[value]) for column, place, value in slopes]
        return Tape(
            np.array(self.constants),
            code,
            np.array([registers[value] for value in lifted], dtype=np.int32),
            np.array(places_of, dtype=np.int32).reshape(-1, 3),
            count,
        )
