"""Formulas of states, parameters and earlier values, such as ``sin(100*position + phase)`` and ``position[-1]``.

Text is read with `ast` against a whitelist and turned into SymPy nodes one by one; nothing is ever evaluated as Python.
From the one SymPy tree come the derivative, the slope bounds, and the program that NumPy, the compiled loops and C
follow. SymPy computes numbers exactly: powers of powers of whole numbers, and exponentials of exponentials, take time
and memory without a bound while they are read. Every operation is therefore settled at once: its numbers become those
of double precision, and what has no finite value there, or is too large, is refused.
"""

from __future__ import annotations

import ast
import math
import operator
import re
import warnings
from collections.abc import Callable
from dataclasses import dataclass
from functools import cache, cached_property, lru_cache
from typing import Any

import numpy as np

from ..core import Array, ConfigError, Parameters, did_you_mean
from .program import FUNCTIONS, Program

Names = tuple[str, ...]

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
MAX_LENGTH = 2000
MAX_EXPONENT = 64
MAX_NODES = 300  # numbers, names, operators and functions
MAX_DEPTH = 20  # functions and powers inside each other; sums and products are as deep as their deepest term
MAX_FACTORS = 40  # of one product, whose derivative has as many terms of as many factors
MAX_TERMS = 2000  # of a formula with parameters, multiplied out
_EXACT = 2**53
_DIGITS = 17  # decimal, of a number of double precision
_CHAINS = ((ast.Add, ast.Sub), (ast.Mult, ast.Div))


@dataclass(frozen=True)
class Formula:
    """One scalar function of named quantities."""

    text: str  # as written by the user
    names: Names  # quantities that may appear
    delayed: Names = ()  # those of which earlier values may appear, such as ``position[-2]``
    sizes: tuple[tuple[str, float], ...] = ()  # sizes of quantities whose values come divided by them
    size: float = 1.0  # what the value of the formula is divided by

    @cached_property
    def written(self) -> Any:
        """SymPy tree of the formula as it is written."""
        return parse(self.text, self.names, self.delayed)

    @cached_property
    def expression(self) -> Any:
        """SymPy tree of the formula, of quantities and with a value that are divided by their sizes."""
        import sympy as sp

        sizes = dict(self.sizes)
        known = {symbol: sizes.get(base_and_delay(symbol.name)[0], 1.0) for symbol in self.written.free_symbols}
        larger = {symbol: sp.Float(size, _DIGITS) * symbol for symbol, size in known.items() if size != 1}
        tree = self.written.xreplace(larger)
        return tree if self.size == 1 else tree * sp.Float(1 / self.size, _DIGITS)

    @cached_property
    def used(self) -> frozenset[str]:
        """Names that the formula depends on, those of earlier values among them."""
        return frozenset(symbol.name for symbol in self.expression.free_symbols)

    def evaluate(self, values: Parameters) -> Array:
        """Evaluate at arrays by name that broadcast against each other."""
        arrays = {name: np.asarray(value, dtype=float) for name, value in values.items()}
        return np.asarray(Program.of([self.expression]).run(arrays)[0])

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


@lru_cache(maxsize=1 << 12)  # a lifting in other units of measure has the same formulas
def parse(text: str, names: Names, delayed: Names = ()) -> Any:
    """Read a formula into a SymPy tree; what may take long is refused before it does."""
    if len(require_text(text)) > MAX_LENGTH:
        raise ConfigError(f"Formula of {len(text)} characters: at most {MAX_LENGTH} are read; split it.")
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("error")  # Python warns of text such as 1if
            tree = ast.parse(text.strip(), mode="eval")
    except (SyntaxError, ValueError, RecursionError, MemoryError, Warning) as error:
        raise ConfigError(f"Formula {text!r}: not readable ({error}).") from error
    try:
        require_size(tree.body)
        return _Reader(text, names, delayed).read(tree.body)
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
        raise ConfigError(f"Formula {text!r}: should be a text, found {type(text).__name__}.")
    return text


@dataclass(frozen=True)
class _Reader:
    text: str
    names: Names
    delayed: Names

    def read(self, node: ast.AST) -> Any:
        """Return the tree of a node, its numbers settled."""
        return settled(self._read(node))

    def _read(self, node: ast.AST) -> Any:
        import sympy as sp

        if isinstance(node, ast.Constant) and type(node.value) in (int, float):
            return sp.Integer(node.value) if isinstance(node.value, int) else sp.Float(node.value, _DIGITS)
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

        steps = ast.unparse(index)
        written = f"{name}[{steps}]"
        if name not in self.delayed:
            known = ", ".join(self.delayed) or "states and inputs"
            raise self._error(f"there is no {written}; only {known} have earlier values.")
        if not re.fullmatch(r"-[1-9]\d*", steps):
            raise self._error(f"{written} is no earlier value; give a whole number of samples, such as {name}[-1].")
        if -int(steps) > MAX_DELAY:
            raise self._error(f"the delay in {written} is too deep; at most {MAX_DELAY} samples are kept.")
        return sp.Symbol(written, real=True)

    def _error(self, problem: str) -> ConfigError:
        return ConfigError(f"Formula {self.text!r}: {problem}")


class TooCostlyError(ConfigError):
    """A part of a formula that is not finite, or takes too long."""


def require_size(tree: ast.AST) -> None:
    """Refuse a tree with too many nodes, or too deep; without recursion, which it may be too deep for."""
    todo, count = list[tuple[ast.AST, int, Any]]([(tree, 0, None)]), 0
    while todo:
        node, depth, chain = todo.pop()
        if isinstance(node, ast.expr):
            count += 1
            kind = next((c for c in _CHAINS if isinstance(node, ast.BinOp) and isinstance(node.op, c)), None)
            depth += not (isinstance(node, ast.Name | ast.Constant) or (kind is not None and kind is chain))
            if count > MAX_NODES:
                raise TooCostlyError(f"has more than {MAX_NODES} numbers, names and operators; split it.")
            if depth > MAX_DEPTH:
                raise TooCostlyError(f"is nested more than {MAX_DEPTH} deep; split it into several functions.")
            chain = kind
        todo += [(child, depth, chain) for child in ast.iter_child_nodes(node)]


def settled(value: Any) -> Any:
    """Return the result of one operation with numbers as doubles hold them; exact whole numbers and fractions stay."""
    import sympy as sp

    if value.is_number:
        return _number(value)
    if value.args and any(a.is_Rational and _large(a) for a in value.args):
        value = value.func(*(_number(a) if a.is_Rational else a for a in value.args))
    for part in (value, *value.args):
        if part.is_number:
            finite(part)
        if isinstance(part, sp.Pow) and part.exp.is_number and abs(finite(part.exp)) > MAX_EXPONENT:
            raise TooCostlyError(f"holds a power of {finite(part.exp):g}; exponents are at most {MAX_EXPONENT}.")
    if isinstance(value, sp.Mul) and len(value.args) > MAX_FACTORS:
        raise TooCostlyError(f"holds a product of {len(value.args)} factors; at most {MAX_FACTORS} are read.")
    return value


def finite(number: Any) -> float:
    """Return the value of a SymPy number in double precision."""
    try:
        value = float(number)
    except (TypeError, ArithmeticError):
        value = math.nan
    if not math.isfinite(value):
        raise TooCostlyError("holds a number that is not finite and real.")
    return value


def count_terms(expression: Any) -> float:
    """Return an upper bound of the terms that multiplying out leaves, of the expression or of any part of it."""
    import sympy as sp

    inner = [count_terms(a) for a in expression.args]
    if isinstance(expression, sp.Add):
        return float(sum(inner))
    if isinstance(expression, sp.Mul):
        return float(math.prod(inner))
    if isinstance(expression, sp.Pow) and expression.exp.is_Integer and inner[0] > 1:
        power = abs(int(expression.exp))
        return float(math.comb(power + min(int(inner[0]), MAX_TERMS) - 1, power))
    return max(inner, default=1.0)


def _number(value: Any) -> Any:
    import sympy as sp

    number = finite(value)
    exact = value.is_Rational and not _large(value)
    return value if exact or (value / sp.pi).is_Rational else sp.Float(number, _DIGITS)


def _large(value: Any) -> bool:
    return bool(abs(value.p) > _EXACT or value.q > _EXACT)
