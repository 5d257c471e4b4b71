"""Families of lifting functions: each returns formulas, and a formula's text is all there is to a lifted function.

Wherever a family takes names, it takes formulas too (delays apart): the polynomials of ``("sin(position)", "velocity")`` are those of the values of these.
Numbers are written so that reading them gives the same number again.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from itertools import combinations_with_replacement

import numpy as np

from ..core.errors import ConfigError
from .formula import MAX_DELAY, delayed_name

Formulas = tuple[str, ...]
MAX_FORMULAS = 100_000  # of one family


def number(value: float) -> str:
    """Write a number as short as it can be read again without a loss."""
    try:
        value = float(value)
    except OverflowError:
        value = math.inf
    if not math.isfinite(value):
        raise ConfigError(f"Lifting families: {value} cannot stand in a formula; give finite numbers.")
    return str(int(value)) if value.is_integer() and abs(value) < 1e15 else repr(value)


def wrapped(formula: str) -> str:
    """Put a formula into parentheses where it is more than a name."""
    return formula if formula.isidentifier() else f"({formula})"


def harmonics(angle: str, ratio: float = 1.0, orders: Sequence[int] = (1,), phase: str | None = None) -> Formulas:
    """Return ``sin(k*(ratio*angle + phase))`` and the cosine of the same, for every order k.

    >>> harmonics("position", 100, [1], "phase")
    ('sin(100*position + phase)', 'cos(100*position + phase)')
    """
    _require_whole("harmonics", "orders", orders, 1)
    if not math.isfinite(ratio) or not ratio:
        raise ConfigError(
            f"harmonics: ratio is {ratio:g}, it should be finite and not zero; give the number of periods per turn of the angle."
        )
    inner = wrapped(angle) if ratio == 1 else f"{number(ratio)}*{wrapped(angle)}"
    inner = inner if phase is None else f"{inner} + {wrapped(phase)}"
    texts = [inner if k == 1 else f"{int(k)}*({inner})" for k in orders]
    return tuple(f"{function}({text})" for text in texts for function in ("sin", "cos"))


def polynomials(names: Sequence[str], degree: int) -> Formulas:
    """Return the monomials of total degree two to `degree`.

    >>> polynomials(["position", "velocity"], 2)
    ('position**2', 'position*velocity', 'velocity**2')
    """
    names = require_names("polynomials", names)
    _require_whole("polynomials", "degree", [degree], 2)
    require_count("polynomials", math.comb(len(names) + degree, degree) if degree <= MAX_FORMULAS else math.inf)
    chosen = (combo for d in range(2, degree + 1) for combo in combinations_with_replacement(names, d))
    return tuple(_monomial(combo) for combo in chosen)


def delays(names: Sequence[str], depth: int) -> Formulas:
    """Return the earlier values of quantities, those of one sample before first.

    >>> delays(["position", "voltage"], 2)
    ('position[-1]', 'voltage[-1]', 'position[-2]', 'voltage[-2]')
    """
    names = require_names("delays", names)
    _require_whole("delays", "depth", [depth], 1)
    others = [name for name in names if not name.isidentifier()]
    if others:
        raise ConfigError(
            f"delays: only states and inputs have earlier values, found {others}; write the delay inside the formula."
        )
    if depth > MAX_DELAY:
        raise ConfigError(f"delays: depth = {depth} is too deep; at most {MAX_DELAY} samples are kept.")
    require_count("delays", depth * len(names))
    return tuple(delayed_name(name, d) for d in range(1, depth + 1) for name in names)


def concatenate(*families: Sequence[str]) -> Formulas:
    """Join families into the functions of one lifting.

    Raises
    ------
    ConfigError
        When a formula appears twice.

    Examples
    --------
    >>> from kros.lifting import Lifting, concatenate, harmonics, polynomials
    >>> functions = concatenate(harmonics("angle", 2), polynomials(["rate"], 2))
    >>> Lifting(("angle", "rate"), functions).lift([[0.0, 3.0]]).tolist()
    [[0.0, 3.0, 0.0, 1.0, 9.0]]
    """
    joined = tuple(text for family in families for text in family)
    repeated = sorted({text for text in joined if joined.count(text) > 1})
    if repeated:
        raise ConfigError(
            f"Lifting families: {', '.join(map(repr, repeated))} appears more than once; leave it out of one family."
        )
    return joined


def _monomial(factors: Sequence[str]) -> str:
    distinct = dict.fromkeys(factors)
    powers = ((wrapped(name), list(factors).count(name)) for name in distinct)
    return "*".join(name if power == 1 else f"{name}**{power}" for name, power in powers)


def require_names(family: str, names: Sequence[str]) -> Formulas:
    """Return names or formulas as a tuple, refusing what is not a list of different ones."""
    listed = isinstance(names, Sequence) and not isinstance(names, str)
    if not listed or not names or not all(isinstance(name, str) and name.strip() for name in names):
        raise ConfigError(f"{family}: needs a list of names or formulas, found {names!r:.200}.")
    if len(set(names)) != len(names):
        raise ConfigError(f"{family}: {list(names)} repeat a name; give each once.")
    return tuple(names)


def is_whole(value: object, least: int) -> bool:
    """Whether a value is a whole number, at least so large and no larger than a double can count."""
    return bool(
        isinstance(value, int | float | np.number)
        and not isinstance(value, bool)
        and least <= value <= 2**53
        and int(value) == value
    )


def require_count(family: str, count: float) -> None:
    """Refuse a family that is larger than anything can use."""
    if count > MAX_FORMULAS:
        raise ConfigError(f"{family}: these options make more than {MAX_FORMULAS} formulas; ask for fewer.")


def _require_whole(family: str, option: str, values: Sequence[int], least: int) -> None:
    listed = isinstance(values, Iterable) and not isinstance(values, str)
    if (
        not listed
        or not (numbers := list(values))
        or not all(is_whole(v, least) for v in numbers)
        or len(set(numbers)) != len(numbers)
    ):
        raise ConfigError(
            f"{family}: {option} = {values!r:.200} should be different whole numbers of at least {least}."
        )
