"""Formulas of states and parameters, such as ``sin(100*position + phase)``.

Text is read with `ast` against a whitelist and turned into SymPy nodes one by one; nothing is ever evaluated as Python.
From the one SymPy tree come the vectorised evaluation, the derivative and the C expression.
"""

from __future__ import annotations

import ast
import operator
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
import numpy.typing as npt

from ..core.errors import ConfigError

Values = Mapping[str, npt.NDArray[np.float64]]
Evaluator = Callable[[Values], Any]

_BINARY = {ast.Add: operator.add, ast.Sub: operator.sub, ast.Mult: operator.mul, ast.Div: operator.truediv, ast.Pow: operator.pow}
_UNARY: dict[type, Callable[[Any], Any]] = {ast.UAdd: operator.pos, ast.USub: operator.neg}
_FUNCTIONS = {
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
_SPELLINGS = {"abs": "Abs"}
_MAX_LENGTH = 2000
_MAX_EXPONENT = 64


@dataclass(frozen=True)
class Formula:
    """One scalar function of named quantities.

    Parameters
    ----------
    text : str
        As written by the user.
    names : tuple of str
        Quantities that may appear.
    """

    text: str
    names: tuple[str, ...]

    @cached_property
    def expression(self) -> Any:
        """SymPy tree of the formula."""
        return parse(self.text, self.names)

    @cached_property
    def used(self) -> frozenset[str]:
        """Names that the formula depends on."""
        return frozenset(symbol.name for symbol in self.expression.free_symbols)

    @cached_property
    def evaluator(self) -> Evaluator:
        """Vectorised evaluation: a mapping from names to arrays gives an array."""
        return compile_expression(self.expression)

    def __call__(self, **values: npt.ArrayLike) -> npt.NDArray[np.float64]:
        """Evaluate at arrays that broadcast against each other."""
        return np.asarray(self.evaluator({k: np.asarray(v, dtype=float) for k, v in values.items()}))

    def derivative(self, name: str) -> Any:
        """Return the SymPy tree of the partial derivative with respect to one name."""
        import sympy as sp

        return sp.diff(self.expression, sp.Symbol(name, real=True))

    def c_expression(self) -> str:
        """Return the formula as a C expression in double precision."""
        import sympy as sp

        return str(sp.ccode(self.expression))


def parse(text: str, names: Sequence[str]) -> Any:
    """Read a formula into a SymPy tree.

    Allowed are numbers, the given names, ``pi``, ``+ - * / **``, parentheses and the functions
    sin, cos, tan, exp, log, sqrt, tanh, atan, abs, sign.

    Raises
    ------
    ConfigError
        When the text holds anything else.
    """
    if len(text) > _MAX_LENGTH:
        raise ConfigError(f"Formula of {len(text)} characters: at most {_MAX_LENGTH} are read; split it into several functions.")
    try:
        tree = ast.parse(text.strip(), mode="eval")
    except (SyntaxError, ValueError, RecursionError) as error:
        raise ConfigError(f"Formula {text!r}: not readable ({error}); write it like 'sin(100*position + phase)'.") from error
    try:
        expression = _convert(tree.body, text, tuple(names))
    except RecursionError as error:
        raise ConfigError(f"Formula {text!r}: nested too deeply; split it into several functions.") from error
    if not expression.is_finite and expression.is_number:
        raise ConfigError(f"Formula {text!r}: evaluates to {expression}; check for a division by zero.")
    return expression


def _convert(node: ast.AST, text: str, names: tuple[str, ...]) -> Any:
    import sympy as sp

    if isinstance(node, ast.Constant) and type(node.value) in (int, float):
        return sp.Integer(node.value) if isinstance(node.value, int) else sp.Float(node.value, 17)
    if isinstance(node, ast.Name):
        if node.id in names:
            return sp.Symbol(node.id, real=True)
        if node.id == "pi":
            return sp.pi
        raise ConfigError(f"Formula {text!r}: unknown name {node.id!r}; known are {', '.join(names)} and pi.")
    if isinstance(node, ast.BinOp) and type(node.op) in _BINARY:
        left, right = _convert(node.left, text, names), _convert(node.right, text, names)
        if isinstance(node.op, ast.Pow) and not (right.is_number and abs(right) <= _MAX_EXPONENT):
            raise ConfigError(f"Formula {text!r}: the exponent {right} should be a number of magnitude at most {_MAX_EXPONENT}.")
        return _BINARY[type(node.op)](left, right)
    if isinstance(node, ast.UnaryOp) and type(node.op) in _UNARY:
        return _UNARY[type(node.op)](_convert(node.operand, text, names))
    if isinstance(node, ast.Call) and isinstance(node.func, ast.Name) and len(node.args) == 1 and not node.keywords:
        function = _SPELLINGS.get(node.func.id, node.func.id)
        if function in _FUNCTIONS:
            return getattr(sp, function)(_convert(node.args[0], text, names))
        raise ConfigError(f"Formula {text!r}: unknown function {node.func.id!r}; known are {', '.join(sorted(_FUNCTIONS))}.")
    raise ConfigError(
        f"Formula {text!r}: {ast.unparse(node)!r} is not allowed; use numbers, names, + - * / ** and functions of one argument."
    )


def compile_expression(expression: Any) -> Evaluator:
    """Turn a SymPy tree into nested closures over NumPy ufuncs; no code is generated."""
    import sympy as sp

    if expression.is_Symbol:
        name = expression.name
        return lambda values: values[name]
    if expression.is_number:
        number = float(expression)
        return lambda values: number
    children = [compile_expression(argument) for argument in expression.args]
    if isinstance(expression, sp.Add):
        return _fold(np.add, children)
    if isinstance(expression, sp.Mul):
        return _fold(np.multiply, children)
    if isinstance(expression, sp.Pow):
        base, exponent = children
        if expression.exp == -1:
            return lambda values: 1.0 / base(values)
        return lambda values: np.power(base(values), exponent(values))
    function = _FUNCTIONS.get(type(expression).__name__)
    if function is None:
        raise ConfigError(
            f"Formula node {expression!r}: no numerical evaluation is known; write the formula with {', '.join(sorted(_FUNCTIONS))}."
        )
    (child,) = children
    return lambda values: function(child(values))


def _fold(combine: Callable[[Any, Any], Any], children: list[Evaluator]) -> Evaluator:
    first, *rest = children

    def evaluate(values: Values) -> Any:
        result = first(values)
        for child in rest:
            result = combine(result, child(values))
        return result

    return evaluate
