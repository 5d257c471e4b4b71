"""Families of lifting functions: each returns formulas, and a formula's text is all there is to a lifted function.

Wherever a family takes names, it takes formulas too (delays apart): the polynomials of ``("sin(position)", "velocity")`` are those of the values of these.
Numbers are written so that reading them gives the same number again.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from itertools import combinations_with_replacement

from ..core.errors import ConfigError
from .formula import MAX_DELAY, delayed_name

Formulas = tuple[str, ...]


def number(value: float) -> str:
    """Write a number as short as it can be read again without a loss.

    >>> number(100.0), number(0.1), number(-2)
    ('100', '0.1', '-2')
    """
    value = float(value)
    if not math.isfinite(value):
        raise ConfigError(f"Lifting families: {value} cannot stand in a formula; give finite numbers.")
    return str(int(value)) if value.is_integer() and abs(value) < 1e15 else repr(value)


def wrapped(formula: str) -> str:
    """Put a formula into parentheses where it is more than a name.

    >>> wrapped("position"), wrapped("position + 1")
    ('position', '(position + 1)')
    """
    return formula if formula.isidentifier() else f"({formula})"


def harmonics(angle: str, ratio: float = 1.0, orders: Sequence[int] = (1,), phase: str | None = None) -> Formulas:
    """Return ``sin(k*(ratio*angle + phase))`` and the cosine of the same, for every order k.

    >>> harmonics("position", 100, [1], "phase")
    ('sin(100*position + phase)', 'cos(100*position + phase)')
    """
    _require_whole("harmonics", "orders", orders, 1)
    if not ratio:
        raise ConfigError("harmonics: ratio is 0, the functions would be constant; give the number of periods per turn of the angle.")
    inner = wrapped(angle) if ratio == 1 else f"{number(ratio)}*{wrapped(angle)}"
    inner = inner if phase is None else f"{inner} + {wrapped(phase)}"
    texts = [inner if k == 1 else f"{k}*({inner})" for k in orders]
    return tuple(f"{function}({text})" for text in texts for function in ("sin", "cos"))


def polynomials(names: Sequence[str], degree: int, lowest: int = 2, cross: bool = True) -> Formulas:
    """Return the monomials of total degree `lowest` to `degree`, with products of different quantities where `cross` is true.

    Without delays among them, the states themselves are lifted already: `lowest` is 2. Of formulas, start at 1.

    >>> polynomials(["position", "velocity"], 2)
    ('position**2', 'position*velocity', 'velocity**2')
    """
    names = require_names("polynomials", names)
    _require_whole("polynomials", "lowest", [lowest], 1)
    _require_whole("polynomials", "degree", [degree], lowest)
    chosen = (combo for d in range(lowest, degree + 1) for combo in combinations_with_replacement(names, d))
    return tuple(_monomial(combo) for combo in chosen if cross or len(set(combo)) == 1)


def delays(names: Sequence[str], depth: int) -> Formulas:
    """Return the earlier values of quantities, those of one sample before first.

    >>> delays(["position", "voltage"], 2)
    ('position[-1]', 'voltage[-1]', 'position[-2]', 'voltage[-2]')
    """
    names = require_names("delays", names)
    _require_whole("delays", "depth", [depth], 1)
    others = [name for name in names if not name.isidentifier()]
    if others:
        raise ConfigError(f"delays: only states and inputs have earlier values, found {others}; write the delay inside the formula.")
    if depth > MAX_DELAY:
        raise ConfigError(f"delays: depth = {depth} is too deep; at most {MAX_DELAY} samples are kept.")
    return tuple(delayed_name(name, d) for d in range(1, depth + 1) for name in names)


def products(names: Sequence[str], others: Sequence[str]) -> Formulas:
    """Return every product of one of `names` and one of `others`: of states and inputs they are the input functions of a bilinear model.

    >>> products(["position", "current"], ["voltage"])
    ('position*voltage', 'current*voltage')
    """
    return tuple(f"{wrapped(a)}*{wrapped(b)}" for b in require_names("products", others) for a in require_names("products", names))


def formulas(functions: Sequence[str]) -> Formulas:
    """Return formulas as they are written, for a place among families."""
    return require_names("formulas", functions)


def concatenate(*families: Sequence[str]) -> Formulas:
    """Join families into the functions of one lifting.

    Raises
    ------
    ConfigError
        When a formula appears twice.
    """
    joined = tuple(text for family in families for text in family)
    repeated = sorted({text for text in joined if joined.count(text) > 1})
    if repeated:
        raise ConfigError(f"Lifting families: {', '.join(map(repr, repeated))} appears more than once; leave it out of one family.")
    return joined


def _monomial(factors: Sequence[str]) -> str:
    distinct = dict.fromkeys(factors)
    powers = ((wrapped(name), list(factors).count(name)) for name in distinct)
    return "*".join(name if power == 1 else f"{name}**{power}" for name, power in powers)


def require_names(family: str, names: Sequence[str]) -> Formulas:
    """Return names or formulas as a tuple, refusing what is not a list of different ones."""
    if isinstance(names, str) or not names or not all(isinstance(name, str) and name.strip() for name in names):
        raise ConfigError(f"{family}: needs a list of names or formulas, found {names!r}.")
    if len(set(names)) != len(names):
        raise ConfigError(f"{family}: {list(names)} repeat a name; give each once.")
    return tuple(names)


def _require_whole(family: str, option: str, values: Sequence[int], least: int) -> None:
    wrong = [v for v in values if type(v) is bool or int(v) != v or v < least]
    if wrong or not values or len(set(values)) != len(values):
        raise ConfigError(f"{family}: {option} = {list(values)} should be different whole numbers of at least {least}.")
