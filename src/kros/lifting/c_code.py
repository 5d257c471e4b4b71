"""Formulas as C99 expressions, in the order of operations of their program."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

from .program import Writer, tree_of

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

    def literal(self, value: float) -> str:
        """Return a literal that is read as the same number of this precision."""
        text = f"{np.float32(value):.9g}" if self.type == "float" else f"{float(value):.17g}"
        return (text if any(c in text for c in ".en") else f"{text}.0") + self.suffix


def c_code(expression: Any, name: Callable[[str], str], precision: Precision | None = None) -> str:
    """Return a SymPy tree as a C expression."""
    writer = Writer(sorted(symbol.name for symbol in expression.free_symbols))
    value = writer.write(tree_of(expression))
    return _CText(writer, name, precision or Precision()).bare(value)


@dataclass(frozen=True)
class _CText:
    writer: Writer
    name: Callable[[str], str]
    precision: Precision

    def bare(self, value: int) -> str:
        """Return the text of a value without the parentheses around a sum or a product."""
        text = self.of(value)
        return text[1:-1] if self._kind(value) in ("add", "multiply") else text

    def of(self, value: int) -> str:
        """Return the text of a value."""
        kind, literal = self._kind(value), self.precision.literal
        if kind == "symbol":
            return self.name(self.writer.names[value])
        if kind == "number":
            text = literal(self.writer.constants[-1 - value])
            return f"({text})" if text.startswith("-") else text
        _, first, second = self.writer.operations[value - len(self.writer.names)]
        if kind in _SIGNS:
            left = self.bare(first) if self._kind(first) == kind else self.of(first)
            return f"({left} {_SIGNS[kind]} {self.of(second)})"
        inner = self.bare(first)
        if kind == "power":
            return f"pow{self.precision.suffix}({inner}, {literal(self.writer.constants[-1 - second])})"
        if kind == "sign":
            zero, one = literal(0.0), literal(1.0)
            return f"((({inner}) > {zero}) ? {one} : ((({inner}) < {zero}) ? -{one} : {zero}))"
        return f"{_NAMES.get(kind, kind)}{self.precision.suffix}({inner})"

    def _kind(self, value: int) -> str:
        if value < 0:
            return "number"
        given = len(self.writer.names)
        return "symbol" if value < given else self.writer.operations[value - given][0]
