"""Physical units of formulas, as far as they follow from those of the states: products and powers multiply, functions have none."""

from __future__ import annotations

import re
from collections.abc import Mapping
from fractions import Fraction
from typing import Any

ONE = "1"
UNKNOWN = ""
Powers = dict[str, Fraction]
_SUPERSCRIPT = str.maketrans("⁰¹²³⁴⁵⁶⁷⁸⁹⁻", "0123456789-")
_RAISE = str.maketrans("0123456789-", "⁰¹²³⁴⁵⁶⁷⁸⁹⁻")
_FACTOR = re.compile(r"([^\W\d_%°]+|[%°]\w*)\^?(-?\d+)?")


def unit_of(expression: Any, known: Mapping[str, str]) -> str:
    """Return the unit of a formula: ``rad·V``, ``1`` for a pure number, empty where it is not known.

    Numbers in products are pure numbers; a sum has a unit only where all its terms have the same one.

    Parameters
    ----------
    expression : SymPy tree
    known : mapping of str to str
        Units of the quantities; an earlier value has that of its quantity.
    """
    powers = _powers(expression, known)
    return UNKNOWN if powers is None else write_unit(powers)


def read_unit(text: str) -> Powers | None:
    """Split a unit such as ``N·m/s^2`` into powers of its factors; None where it cannot be read.

    >>> {name: int(power) for name, power in read_unit("rad/s^2").items()}
    {'rad': 1, 's': -2}
    """
    powers: Powers = {}
    sign = 1
    for part in re.split(r"(·|\*|/|\s+)", text.strip().replace("**", "^").translate(_SUPERSCRIPT)):
        if part == "/":
            sign = -1
        elif part.strip() and part not in ("·", "*"):
            if part == ONE:
                sign = 1
                continue
            match = _FACTOR.fullmatch(part)
            if match is None:
                return None
            powers[match[1]] = powers.get(match[1], Fraction(0)) + sign * Fraction(match[2] or 1)
            sign = 1
    return powers if text.strip() else None


def write_unit(powers: Powers) -> str:
    """Write powers of factors as one unit, those below the line last."""
    above = [_raised(name, power) for name, power in powers.items() if power > 0]
    below = [_raised(name, -power) for name, power in powers.items() if power < 0]
    return "/".join(["·".join(above) or ONE, *below])


def _raised(name: str, power: Fraction) -> str:
    return name if power == 1 else name + str(power).translate(_RAISE)


def _powers(expression: Any, known: Mapping[str, str]) -> Powers | None:
    import sympy as sp

    if expression.is_Symbol:
        return read_unit(known.get(expression.name.partition("[")[0], UNKNOWN))
    if expression.is_number:
        return {}
    if isinstance(expression, sp.Add):
        first, *rest = (_powers(term, known) for term in expression.args)
        return first if all(other == first for other in rest) else None
    if isinstance(expression, sp.Mul):
        product: Powers = {}
        for factor in expression.args:
            own = _powers(factor, known)
            if own is None:
                return None
            product = {name: product.get(name, Fraction(0)) + own.get(name, Fraction(0)) for name in (*product, *own)}
        return {name: power for name, power in product.items() if power}
    if isinstance(expression, sp.Pow) and expression.exp.is_number:
        base = _powers(expression.base, known)
        exponent = Fraction(str(sp.nsimplify(expression.exp, rational=True)))
        raised = None if base is None else {name: power * exponent for name, power in base.items()}
        return raised if raised is None or all(power.denominator == 1 for power in raised.values()) else None
    if isinstance(expression, sp.Abs):
        return _powers(expression.args[0], known)
    return {}
