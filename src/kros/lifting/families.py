"""Families of lifting functions: each returns formulas, and a formula's text is all there is to a lifted function.

Wherever a family takes names, it takes formulas too (delays apart): the polynomials of ``("sin(position)",
"velocity")`` are those of the values of these. Numbers are written so that reading them gives the same number again. In
a study a family is a table, ``[[lifting.families]]``: the kind chooses the function, the other keys are its arguments.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable, Mapping
from functools import wraps
from inspect import signature
from itertools import combinations_with_replacement
from typing import Annotated, Any, TypeVar

import numpy as np
from pydantic import AfterValidator, ConfigDict, Field, FiniteFloat, ValidationError, validate_call

from ..core import Array, ConfigError
from .formula import MAX_DELAY, delayed_name

Formulas = tuple[str, ...]
T = TypeVar("T")
MAX_FORMULAS = 100_000  # of one family


def _different(values: Any) -> Any:
    if len(set(values)) < len(values):
        raise ValueError(f"{list(values)} repeat one; give each once")
    return values


def _not_zero(value: float) -> float:
    if not value:
        raise ValueError("should not be zero; give the number of periods per turn of the angle")
    return value


Text = Annotated[str, Field(min_length=1)]
Names = Annotated[tuple[Text, ...], Field(min_length=1), AfterValidator(_different)]
Count = Annotated[int, Field(ge=1, le=MAX_FORMULAS)]
Length = Annotated[FiniteFloat, Field(gt=0)]
Lengths = Length | tuple[Length, ...]


def checked(function: Callable[..., T]) -> Callable[..., T]:
    """Refuse arguments of the wrong kind or size with a ConfigError that names them."""
    validated = validate_call(config=ConfigDict(arbitrary_types_allowed=True))(function)
    names = tuple(signature(function).parameters)

    @wraps(function)
    def call(*args: Any, **kwargs: Any) -> T:
        try:
            return validated(*args, **kwargs)
        except ValidationError as error:
            found = ((e["loc"][0], e["msg"].lower()) for e in error.errors())
            problems = dict.fromkeys(f"{names[at] if isinstance(at, int) else at}: {text}" for at, text in found)
            raise ConfigError(f"{function.__name__}: {'; '.join(problems)}.") from error

    return call


@checked
def harmonics(
    angle: str,
    ratio: Annotated[FiniteFloat, AfterValidator(_not_zero)] = 1.0,
    orders: Annotated[tuple[Count, ...], Field(min_length=1), AfterValidator(_different)] = (1,),
    phase: str | None = None,
) -> Formulas:
    """Return ``sin(k*(ratio*angle + phase))`` and the cosine of the same, for every order k.

    >>> harmonics("position", 100, [1], "phase")
    ('sin(100*position + phase)', 'cos(100*position + phase)')
    """
    inner = (f"{number(ratio)}*" if ratio != 1 else "") + wrapped(angle) + (f" + {wrapped(phase)}" if phase else "")
    texts = [inner if k == 1 else f"{k}*({inner})" for k in orders]
    return tuple(f"{function}({text})" for text in texts for function in ("sin", "cos"))


@checked
def polynomials(names: Names, degree: Annotated[int, Field(ge=2, le=MAX_FORMULAS)]) -> Formulas:
    """Return the monomials of total degree two to `degree`.

    >>> polynomials(["position", "velocity"], 2)
    ('position**2', 'position*velocity', 'velocity**2')
    """
    _require_count("polynomials", math.comb(len(names) + degree, degree))
    chosen = (Counter(c) for d in range(2, degree + 1) for c in combinations_with_replacement(names, d))
    monomials = ([f"{wrapped(n)}**{p}" if p > 1 else wrapped(n) for n, p in powers.items()] for powers in chosen)
    return tuple("*".join(factors) for factors in monomials)


@checked
def delays(names: Names, depth: Annotated[int, Field(ge=1, le=MAX_DELAY)]) -> Formulas:
    """Return the earlier values of quantities, those of one sample before first.

    >>> delays(["position", "voltage"], 2)
    ('position[-1]', 'voltage[-1]', 'position[-2]', 'voltage[-2]')
    """
    if others := [name for name in names if not name.isidentifier()]:
        problem = f"only states and inputs have earlier values, found {others}"
        raise ConfigError(f"delays: {problem}; write the delay inside the formula.")
    _require_count("delays", depth * len(names))
    return tuple(delayed_name(name, d) for d in range(1, depth + 1) for name in names)


@checked
def radial(names: Names, centres: Any, length: Lengths) -> Formulas:
    """Return ``exp(-s**2/2)`` for every centre c, of the scaled distance ``s**2 = sum_i ((q_i - c_i)/length_i)**2``.

    Of d quantities, or formulas, the centres (n, d) and lengths, one or (d,), are in their units; see `kmeans_centres`.

    >>> radial(["position", "velocity"], [[0.5, 0]], [0.1, 2])
    ('exp(-(((position - 0.5)/0.1)**2 + ((velocity - 0)/2)**2)/2)',)
    """
    lengths, centres = np.asarray(length, dtype=float), _finite("radial: centres", centres)
    if lengths.shape not in ((), (len(names),)):
        raise ConfigError(f"radial: length = {length} should be one number, or {len(names)}, one for each quantity.")
    if centres.shape[1] != len(names) or not len(centres):
        raise ConfigError(f"radial: centres should have the shape (n, {len(names)}), found shape {centres.shape}.")
    lengths = np.broadcast_to(lengths, (len(names),))
    texts = []
    for centre in centres:
        columns = zip(names, centre, lengths, strict=True)
        parts = (f"(({wrapped(name)} - {number(c)})/{number(scale)})**2" for name, c, scale in columns)
        texts.append(f"exp(-({' + '.join(parts)})/2)")
    return tuple(texts)


@checked
def kmeans_centres(data: Any, n: Count, seed: Annotated[int, Field(ge=0)], starts: Count = 8) -> Array:
    """Return the means of n clusters, shape (n, d), of data (n_samples, d), the best of some starts.

    Distances count in units of standard deviations.

    >>> from kros.lifting import kmeans_centres
    >>> sorted(kmeans_centres([[0.0], [0.2], [9.0], [9.2]], n=2, seed=0).round(9).ravel().tolist())
    [0.1, 9.1]
    """
    from scipy.cluster.vq import kmeans

    data = _finite("kmeans_centres: data", data)
    spread = np.where(np.ptp(data, axis=0) > 0, data.std(axis=0), 1.0)
    means, _ = kmeans(data / spread, int(n), iter=starts, rng=np.random.default_rng(seed))
    if len(means) < n:
        raise ConfigError(f"kmeans_centres: the data have {len(means)} clusters, not {n}; ask for fewer.")
    return means * spread


@checked
def quantities(names: Names) -> Formulas:
    """Return names that radial functions can have."""
    return names


KINDS: dict[str, Callable[..., Any]] = {
    "harmonics": harmonics,
    "polynomials": polynomials,
    "radial": radial,
    "delays": delays,
}


def family(table: Mapping[str, Any], sample: Callable[[Formulas], Array] | None = None) -> Formulas:
    """Return the formulas of a family given as a table; k-means takes its data from `sample`."""
    arguments = dict(table)
    if isinstance(arguments.get("centres"), Mapping):
        centres = dict(arguments["centres"])
        if centres.get("kind") == "kmeans" and sample is not None:
            centres["data"] = sample(quantities(arguments.get("names", ())))
        arguments["centres"] = _call("centres", {"kmeans": kmeans_centres}, centres)
    return tuple(_call("family", KINDS, arguments))


def check_family(table: Mapping[str, Any]) -> None:
    """Refuse what can be refused without data."""
    centres = table.get("centres")
    if isinstance(centres, Mapping) and "data" in centres:
        raise ConfigError("Lifting centres 'kmeans': unknown key 'data'; the data are those of the study.")
    count = centres.get("n", 1) if isinstance(centres, Mapping) else 1
    rows = int(count) if isinstance(count, int) and 0 < count <= MAX_FORMULAS else 1
    family(table, lambda names: np.random.default_rng(0).normal(size=(rows, len(names))))


def _call(what: str, kinds: Mapping[str, Callable[..., Any]], table: Mapping[str, Any]) -> Any:
    arguments = dict(table)
    kind = arguments.pop("kind", None)
    if not isinstance(kind, str) or kind not in kinds:
        raise ConfigError(f"Lifting {what}: kind = {kind!r} is unknown; known are {', '.join(kinds)}.")
    return kinds[kind](**arguments)


def number(value: float) -> str:
    """Write a finite number as short as it can be read again without a loss."""
    value = float(value)
    return str(int(value)) if value.is_integer() and abs(value) < 1e15 else repr(value)


def wrapped(formula: str) -> str:
    """Put a formula into parentheses where it is more than a name."""
    return formula if formula.isidentifier() else f"({formula})"


def _finite(what: str, values: Any) -> Array:
    """Return a finite matrix."""
    try:
        matrix = np.asarray(values, dtype=float)
    except (TypeError, ValueError, OverflowError) as error:
        raise ConfigError(f"{what}: {error}.") from error
    if matrix.ndim != 2 or not np.isfinite(matrix).all():
        raise ConfigError(f"{what} should be a finite matrix, found shape {matrix.shape}.")
    return matrix


def _require_count(kind: str, count: float) -> None:
    if count > MAX_FORMULAS:
        raise ConfigError(f"{kind}: these options make more than {MAX_FORMULAS} formulas; ask for fewer.")
