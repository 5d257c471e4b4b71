"""Formulas of states, parameters and earlier values, such as ``sin(100*position + phase)`` and ``position[-1]``.

Text is read with `ast` against a whitelist and turned into SymPy nodes one by one; nothing is ever evaluated as Python.
From the one SymPy tree come the derivative, the slope bounds, and the program that NumPy, the compiled loops and C
follow.
"""

from __future__ import annotations

import ast
import operator
import warnings
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import cache, cached_property, lru_cache
from typing import Any

import numpy as np
import numpy.typing as npt

from ..core.errors import ConfigError
from ..core.files import did_you_mean
from .limits import MAX_EXPONENT, MAX_LENGTH, TooCostlyError, finite, require_size, settled
from .program import FUNCTIONS, Program

_OPERATORS: dict[type, Callable[..., Any]] = {
    ast.Add: operator.add,
    ast.Sub: operator.sub,
    ast.Mult: operator.mul,
    ast.Div: operator.truediv,
    ast.Pow: operator.pow,
    ast.UAdd: operator.pos,
    ast.USub: operator.neg,
}
_SPELLINGS = {"abs": "Abs"}
MAX_DELAY = 1000


@dataclass(frozen=True)
class Formula:
    """One scalar function of named quantities."""

    text: str  # as written by the user
    names: tuple[str, ...]  # quantities that may appear
    delayed: tuple[
        str, ...
    ] = ()  # those of which earlier values may appear: ``position[-2]`` is that two samples before
    sizes: tuple[tuple[str, float], ...] = ()  # sizes of quantities whose values come divided by them
    size: float = 1.0  # what the value of the formula is divided by

    @cached_property
    def written(self) -> Any:
        """SymPy tree of the formula as it is written."""
        return _remembered(require_text(self.text), self.names, self.delayed)

    @cached_property
    def expression(self) -> Any:
        """SymPy tree of the formula, of quantities and with a value that are divided by their sizes."""
        import sympy as sp

        sizes = dict(self.sizes)
        known = {symbol: sizes.get(base_and_delay(symbol.name)[0], 1.0) for symbol in self.written.free_symbols}
        larger = {symbol: sp.Float(size, 17) * symbol for symbol, size in known.items() if size != 1}
        tree = self.written.xreplace(larger)
        return tree if self.size == 1 else tree * sp.Float(1 / self.size, 17)

    @cached_property
    def used(self) -> frozenset[str]:
        """Names that the formula depends on; an earlier value has a name of its own."""
        return frozenset(symbol.name for symbol in self.expression.free_symbols)

    @cached_property
    def _program(self) -> Program:
        return Program.of([self.expression])

    def __call__(self, **values: npt.ArrayLike) -> npt.NDArray[np.float64]:
        """Evaluate at arrays that broadcast against each other."""
        return self.evaluate({name: np.asarray(value, dtype=float) for name, value in values.items()})

    def evaluate(self, values: Mapping[str, npt.NDArray[np.float64]]) -> npt.NDArray[np.float64]:
        """Evaluate at arrays by name."""
        return np.asarray(self._program.run(values)[0])

    def derivative(self, name: str) -> Any:
        """Return the SymPy tree of the partial derivative with respect to one name."""
        import sympy as sp

        magnitude, jump = _real_magnitude()
        real = self.expression.replace(sp.Abs, magnitude).replace(sp.sign, jump)
        return sp.diff(real, sp.Symbol(name, real=True)).replace(magnitude, sp.Abs).replace(jump, sp.sign)


def delayed_name(name: str, delay: int) -> str:
    """Return the name of a quantity `delay` samples ago."""
    return f"{name}[-{delay}]" if delay else name


def base_and_delay(name: str) -> tuple[str, int]:
    """Return the quantity behind a name, and how many samples before it is meant."""
    base, _, index = name.partition("[")
    return base, -int(index[:-1]) if index else 0


def parse(text: str, names: Sequence[str], delayed: Sequence[str] = ()) -> Any:
    """Read a formula into a SymPy tree. What may take long is refused before it does: see `limits`."""
    if len(require_text(text)) > MAX_LENGTH:
        remedy = f"at most {MAX_LENGTH} are read; split it into several functions"
        raise ConfigError(f"Formula of {len(text)} characters: {remedy}.")
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("error")  # Python warns of text such as 1if
            tree = ast.parse(text.strip(), mode="eval")
    except (SyntaxError, ValueError, RecursionError, MemoryError, Warning) as error:
        remedy = "write it like 'sin(100*position + phase)'"
        raise ConfigError(f"Formula {text!r}: not readable ({error}); {remedy}.") from error
    try:
        require_size(tree.body)
        return _Reader(text, tuple(names), tuple(delayed)).read(tree.body)
    except TooCostlyError as error:
        raise ConfigError(f"Formula {text!r}: {error}") from error


@cache
def _real_magnitude() -> tuple[Any, Any]:
    """Functions that differentiate as Abs and sign do for real numbers; SymPy's ask whether these are complex."""
    import sympy as sp

    jump = type("RealSign", (sp.Function,), {"fdiff": lambda self, argindex=1: 2 * sp.DiracDelta(self.args[0])})
    return type("RealMagnitude", (sp.Function,), {"fdiff": lambda self, argindex=1: jump(self.args[0])}), jump


def require_text(text: object) -> str:
    """Return what is a text, as a formula should be."""
    if not isinstance(text, str):
        needed = "should be a text such as 'sin(100*position + phase)'"
        raise ConfigError(f"Formula {text!r}: {needed}, found {type(text).__name__}.")
    return text


_remembered = lru_cache(maxsize=1 << 12)(parse)  # a lifting in other units of measure has the same formulas


@dataclass(frozen=True)
class _Reader:
    text: str
    names: tuple[str, ...]
    delayed: tuple[str, ...]

    def read(self, node: ast.AST) -> Any:
        """Return the tree of a node, its numbers settled."""
        return settled(self._read(node))

    def _read(self, node: ast.AST) -> Any:
        import sympy as sp

        if isinstance(node, ast.Constant) and type(node.value) in (int, float):
            return sp.Integer(node.value) if isinstance(node.value, int) else sp.Float(node.value, 17)
        if isinstance(node, ast.Name):
            return self._name(node.id)
        if isinstance(node, ast.Subscript) and isinstance(node.value, ast.Name):
            return self._earlier(node.value.id, node.slice)
        if isinstance(node, ast.BinOp) and type(node.op) in _OPERATORS:
            left, right = self.read(node.left), self.read(node.right)
            if isinstance(node.op, ast.Pow) and not (right.is_number and abs(finite(right)) <= MAX_EXPONENT):
                raise self._error(f"the exponent {right} should be a number of magnitude at most {MAX_EXPONENT}.")
            return _OPERATORS[type(node.op)](left, right)
        if isinstance(node, ast.UnaryOp) and type(node.op) in _OPERATORS:
            return _OPERATORS[type(node.op)](self.read(node.operand))
        if isinstance(node, ast.Call) and isinstance(node.func, ast.Name) and len(node.args) == 1 and not node.keywords:
            function = _SPELLINGS.get(node.func.id, node.func.id)
            if function in FUNCTIONS:
                return getattr(sp, function)(self.read(node.args[0]))
            raise self._error(f"unknown function {node.func.id!r}; known are {', '.join(sorted(FUNCTIONS))}.")
        remedy = "use numbers, names, + - * / ** and functions of one argument"
        raise self._error(f"{ast.unparse(node)!r} is not allowed; {remedy}.")

    def _name(self, name: str) -> Any:
        import sympy as sp

        if name in self.names:
            return sp.Symbol(name, real=True)
        if name == "pi":
            return sp.pi
        near = did_you_mean(name, self.names) or ";"
        raise self._error(f"unknown name {name!r}{near} known are {', '.join(self.names)} and pi.")

    def _earlier(self, name: str, index: ast.expr) -> Any:
        import sympy as sp

        written = f"{name}[{ast.unparse(index)}]"
        if name not in self.delayed:
            known = ", ".join(self.delayed) or "states and inputs"
            raise self._error(f"there is no {written}; only {known} have earlier values.")
        negative = isinstance(index, ast.UnaryOp) and isinstance(index.op, ast.USub)
        amount = index.operand if isinstance(index, ast.UnaryOp) else index
        if not isinstance(amount, ast.Constant) or type(amount.value) is not int:
            raise self._error(f"the delay in {written} should be a whole number of samples, such as {name}[-1].")
        if not negative or amount.value == 0:
            example = f"write {name}[-1] for one sample before, {name} for the present"
            raise self._error(f"{written} is not an earlier value; {example}.")
        if amount.value > MAX_DELAY:
            raise self._error(f"the delay in {written} is too deep; at most {MAX_DELAY} samples are kept.")
        return sp.Symbol(delayed_name(name, amount.value), real=True)

    def _error(self, problem: str) -> ConfigError:
        return ConfigError(f"Formula {self.text!r}: {problem}")
