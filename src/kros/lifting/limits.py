"""What a formula may cost: bounds that keep reading, differentiating and evaluating it short, whatever its text.

SymPy computes numbers exactly: powers of powers of whole numbers, and exponentials of exponentials, take time and
memory without a bound while they are read. Every operation is therefore settled at once: its numbers become those of
double precision, and what has no finite value there is refused.
"""

from __future__ import annotations

import ast
import math
from typing import Any

from ..core.errors import ConfigError

MAX_LENGTH = 2000
MAX_EXPONENT = 64
MAX_NODES = 300  # numbers, names, operators and functions
MAX_DEPTH = 20  # functions and powers inside each other; sums and products are as deep as their deepest term
MAX_FACTORS = 40  # of one product, whose derivative has as many terms of as many factors
MAX_TERMS = 2000  # of a formula with parameters, multiplied out
_EXACT = 2**53
_CHAINS = ((ast.Add, ast.Sub), (ast.Mult, ast.Div))


class TooCostlyError(ConfigError):
    """A part of a formula that is not finite, or takes too long."""


def require_size(tree: ast.AST) -> None:
    """Refuse a tree with too many nodes, or too deep; without recursion, which it may be too deep for."""
    todo: list[tuple[ast.AST, int, Any]] = [(tree, 0, None)]
    count = 0
    while todo:
        node, depth, chain = todo.pop()
        if isinstance(node, ast.expr):
            count += 1
            own = next((c for c in _CHAINS if isinstance(node, ast.BinOp) and isinstance(node.op, c)), None)
            depth += not (isinstance(node, ast.Name | ast.Constant) or (own is not None and own is chain))
            if count > MAX_NODES or depth > MAX_DEPTH:
                many, deep = (
                    f"has more than {MAX_NODES} numbers, names and operators",
                    f"is nested more than {MAX_DEPTH} deep",
                )
                raise TooCostlyError(f"{many if count > MAX_NODES else deep}; split it into several functions.")
            chain = own
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
            problem = f"holds a power of {finite(part.exp):g}"
            raise TooCostlyError(f"{problem}; exponents are numbers of magnitude at most {MAX_EXPONENT}.")
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
        remedy = "check for a division by zero, a root of a negative number, and powers"
        raise TooCostlyError(f"holds a number that is not finite and real; {remedy}.")
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
    return value if exact or (value / sp.pi).is_Rational else sp.Float(number, 17)


def _large(value: Any) -> bool:
    return bool(abs(value.p) > _EXACT or value.q > _EXACT)
