"""SymPy trees as C99 expressions, in the order of operations in which kros evaluates them."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

from ..core.errors import ConfigError
from .evaluation import shape_of

_DIRECT = ("sin", "cos", "tan", "exp", "log", "sqrt", "tanh", "atan")


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
    numbers: list[float] = []
    shape = shape_of(expression, numbers)
    text = _CWriter(name, precision or Precision(), iter(numbers)).write(shape)
    return text[1:-1] if shape[0] in ("add", "multiply") else text


@dataclass(frozen=True)
class _CWriter:
    name: Callable[[str], str]
    precision: Precision
    numbers: Any

    def write(self, shape: Any) -> str:
        kind, *rest = shape
        if kind == "symbol":
            return self.name(rest[0])
        if kind == "number":
            value = next(self.numbers)
            text = self.precision.literal(value)
            return f"({text})" if value < 0 else text
        if kind in ("add", "multiply"):
            return "(" + (" + " if kind == "add" else " * ").join(self.write(child) for child in rest) + ")"
        if kind == "power":
            return self._power(rest[0], self.write(rest[1]))
        inner, suffix = self.write(rest[0]), self.precision.suffix
        inner = inner[1:-1] if rest[0][0] in ("add", "multiply") else inner
        if kind in _DIRECT:
            return f"{kind}{suffix}({inner})"
        if kind == "Abs":
            return f"fabs{suffix}({inner})"
        if kind == "sign":
            zero, one = self.precision.literal(0.0), self.precision.literal(1.0)
            return f"((({inner}) > {zero}) ? {one} : ((({inner}) < {zero}) ? -{one} : {zero}))"
        raise ConfigError(f"Formula node {kind!r}: it has no expression in C; write the formula with other functions.")

    def _power(self, exponent: float, base: str) -> str:
        one, suffix = self.precision.literal(1.0), self.precision.suffix
        plain = {
            2.0: f"({base} * {base})",
            3.0: f"({base} * {base} * {base})",
            -1.0: f"({one} / {base})",
            -2.0: f"({one} / ({base} * {base}))",
        }
        roots = {0.5: f"sqrt{suffix}({base})", -0.5: f"({one} / sqrt{suffix}({base}))"}
        return {**plain, **roots}.get(exponent, f"pow{suffix}({base}, {self.precision.literal(exponent)})")
