"""Families of lifting functions: each returns formulas, and a formula's text is all there is to a lifted function.

Wherever a family takes names, it takes formulas too (delays apart): the polynomials of ``("sin(position)",
"velocity")`` are those of the values of these. Numbers are written so that reading them gives the same number again. In
a study a family is a table, ``[[lifting.families]]``: the kind chooses the function, the other keys are its arguments.
"""

from __future__ import annotations

import inspect
import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from itertools import combinations_with_replacement
from typing import Any

import numpy as np
import numpy.typing as npt

from ..core.errors import ConfigError
from .formula import MAX_DELAY, delayed_name

Array = npt.NDArray[np.float64]
Formulas = tuple[str, ...]
MAX_FORMULAS = 100_000  # of one family


def harmonics(angle: str, ratio: float = 1.0, orders: Sequence[int] = (1,), phase: str | None = None) -> Formulas:
    """Return ``sin(k*(ratio*angle + phase))`` and the cosine of the same, for every order k.

    >>> harmonics("position", 100, [1], "phase")
    ('sin(100*position + phase)', 'cos(100*position + phase)')
    """
    _require_whole("harmonics", "orders", orders, 1)
    if not math.isfinite(ratio) or not ratio:
        remedy = "it should be finite and not zero; give the number of periods per turn of the angle"
        raise ConfigError(f"harmonics: ratio is {ratio:g}, {remedy}.")
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
    _require_count("polynomials", math.comb(len(names) + degree, degree) if degree <= MAX_FORMULAS else math.inf)
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
        remedy = "write the delay inside the formula"
        raise ConfigError(f"delays: only states and inputs have earlier values, found {others}; {remedy}.")
    if depth > MAX_DELAY:
        raise ConfigError(f"delays: depth = {depth} is too deep; at most {MAX_DELAY} samples are kept.")
    _require_count("delays", depth * len(names))
    return tuple(delayed_name(name, d) for d in range(1, depth + 1) for name in names)


def radial(names: Sequence[str], centres: npt.ArrayLike, length: float | Sequence[float]) -> Formulas:
    """Return ``exp(-s**2/2)`` for every centre c, of the scaled distance ``s**2 = sum_i ((q_i - c_i)/length_i)**2``.

    Parameters
    ----------
    names : sequence of str
        Quantities, or formulas, that span the space; d of them.
    centres : array_like, shape (n_centres, d)
        In the units of the quantities; see `kmeans_centres`.
    length : float or sequence of float, shape (d,)
        Length scale of every quantity, in its unit.

    Returns
    -------
    tuple of str

    Examples
    --------
    >>> radial(["position", "velocity"], [[0.5, 0]], [0.1, 2])
    ('exp(-(((position - 0.5)/0.1)**2 + (velocity/2)**2)/2)',)
    """
    names = require_names("radial", names)
    lengths = _length_scales("radial", length, len(names))
    centres = np.asarray(centres, dtype=float)
    if centres.ndim != 2 or centres.shape[1] != len(names) or not len(centres) or not np.isfinite(centres).all():
        needed = f"centres for {list(names)} should be finite and have the shape (n, {len(names)})"
        raise ConfigError(f"radial: {needed}, found shape {centres.shape}.")
    return tuple(f"exp(-({_squared_distance(names, centre, lengths)})/2)" for centre in centres)


def fourier_features(names: Sequence[str], n: int, length: float | Sequence[float], seed: int) -> Formulas:
    """Return random Fourier features ``sqrt(2/n)*cos(w*q + b)``, whose inner product tends to the Gaussian kernel.

    The kernel is ``exp(-s**2/2)`` with the scaled distance s, as in `radial`.

    Parameters
    ----------
    names : sequence of str
        Quantities, or formulas; d of them.
    n : int
    length : float or sequence of float, shape (d,)
    seed : int

    References
    ----------
    A. Rahimi and B. Recht, "Random features for large-scale kernel machines", Advances in Neural Information Processing
    Systems 20, 2007.

    Examples
    --------
    >>> from kros.lifting import fourier_features
    >>> len(fourier_features(["angle", "rate"], n=20, length=[0.5, 2.0], seed=0))
    20
    """
    names = require_names("fourier", names)
    lengths = _length_scales("fourier", length, len(names))
    _require_whole("fourier", "n", [n], 1)
    _require_count("fourier", n)
    rng = np.random.default_rng(seed)
    frequencies = rng.standard_normal(size=(int(n), len(names))) / lengths
    shifts = rng.uniform(0, 2 * np.pi, size=int(n))
    size, inner = number(np.sqrt(2 / n)), [wrapped(name) for name in names]
    angles = (" + ".join(f"({number(w)})*{q}" for w, q in zip(row, inner, strict=True)) for row in frequencies)
    return tuple(f"{size}*cos({angle} + {number(b)})" for angle, b in zip(angles, shifts, strict=True))


def kmeans_centres(data: npt.ArrayLike, n: int, seed: int, starts: int = 8) -> Array:
    """Return the means of n clusters, shape (n, d), the best of some starts, in units of standard deviations.

    Parameters
    ----------
    data : array_like, shape (n_samples, d)
    n : int
    seed : int
    starts : int

    Examples
    --------
    >>> from kros.lifting import kmeans_centres
    >>> sorted(kmeans_centres([[0.0], [0.2], [9.0], [9.2]], n=2, seed=0).round(9).ravel().tolist())
    [0.1, 9.1]
    """
    from scipy.cluster.vq import ClusterError, kmeans2

    data = np.asarray(data, dtype=float)
    if data.ndim != 2 or not np.isfinite(data).all():
        raise ConfigError(f"Centres by k-means: need finite data of shape (n_samples, d), found shape {data.shape}.")
    _require_whole("centres", "n", [n], 1)
    _require_count("centres", n)
    distinct = len(np.unique(data, axis=0))
    if distinct < n:
        raise ConfigError(
            f"Centres by k-means: {n} clusters need as many different samples, found {distinct}; ask for fewer."
        )
    spread = data.std(axis=0)
    spread[spread == 0] = 1.0
    rng, scaled = np.random.default_rng(seed), data / spread
    ends: list[tuple[float, Array]] = []
    for _ in range(starts):
        try:
            means, label = kmeans2(scaled, n, iter=100, minit="++", missing="raise", rng=rng)
        except ClusterError:  # this start has an empty cluster
            continue
        ends.append((float(np.sum((scaled - means[label]) ** 2)), np.asarray(means * spread)))
    if not ends:
        raise ConfigError(f"Centres by k-means: in {starts} starts one of {n} clusters was empty; ask for fewer.")
    return min(ends, key=lambda end: end[0])[1]


KINDS: dict[str, Callable[..., Any]] = {
    "harmonics": harmonics,
    "polynomials": polynomials,
    "radial": radial,
    "fourier": fourier_features,
    "delays": delays,
}


def family(table: Mapping[str, Any], sample: Callable[[Formulas], Array] | None = None) -> Formulas:
    """Return the formulas of a family given as a table; k-means takes its data from `sample`."""
    arguments = dict(table)
    if isinstance(arguments.get("centres"), Mapping):
        given = arguments["centres"]
        if given.get("kind") == "kmeans" and sample is not None:
            given = {**given, "data": sample(require_names("centres", arguments.get("names", ())))}
        arguments["centres"] = _call("centres", {"kmeans": kmeans_centres}, given)
    return tuple(_call("family", KINDS, arguments))


def check_family(table: Mapping[str, Any]) -> None:
    """Refuse what can be refused without data."""
    centres = table.get("centres")
    if not isinstance(centres, Mapping) or centres.get("kind") != "kmeans":
        family(table)
        return
    if "data" in centres:
        raise ConfigError("Lifting centres 'kmeans': unknown key 'data'; the data are those of the study.")
    count, names = centres.get("n", 1), table.get("names", ())
    rows = int(count) if _is_whole(count, 1) and count <= MAX_FORMULAS else 1
    points = np.random.default_rng(0).normal(size=(rows, len(names) if isinstance(names, list | tuple) else 1))
    family(table, lambda _: points)


def _call(what: str, kinds: Mapping[str, Callable[..., Any]], table: Mapping[str, Any]) -> Any:
    arguments = dict(table)
    kind = arguments.pop("kind", None)
    if not isinstance(kind, str) or kind not in kinds:
        raise ConfigError(f"Lifting {what}: kind = {kind!r} is unknown; known are {', '.join(kinds)}.")
    known = inspect.signature(kinds[kind]).parameters
    problems = [f"unknown key {key!r}" for key in arguments if key not in known]
    problems += [f"{key!r} is missing" for key, p in known.items() if p.default is p.empty and key not in arguments]
    if problems:
        raise ConfigError(f"Lifting {what} {kind!r}: {', '.join(problems)}; it takes {', '.join(known)}.")
    try:
        return kinds[kind](**arguments)
    except ConfigError:
        raise
    except (TypeError, ValueError, ArithmeticError, AttributeError) as error:
        raise ConfigError(f"Lifting {what} {kind!r}: {error}; check {table!s:.500}.") from error


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


def _monomial(factors: Sequence[str]) -> str:
    powers = ((wrapped(name), list(factors).count(name)) for name in dict.fromkeys(factors))
    return "*".join(name if power == 1 else f"{name}**{power}" for name, power in powers)


def _squared_distance(names: Sequence[str], centre: Array, lengths: Array) -> str:
    terms = []
    for name, c, scale in zip(names, centre, lengths, strict=True):
        offset = wrapped(name) if c == 0 else f"({wrapped(name)} {'-' if c > 0 else '+'} {number(abs(c))})"
        terms.append(f"({offset}/{number(scale)})**2" if scale != 1 else f"{offset}**2")
    return " + ".join(terms)


def _length_scales(kind: str, length: float | Sequence[float], n: int) -> Array:
    lengths = np.asarray(length, dtype=float)
    if lengths.shape not in ((), (n,)) or not np.isfinite(lengths).all() or np.any(lengths <= 0):
        needed = f"should be a positive number, or {n} of them, one for each quantity"
        raise ConfigError(f"{kind}: length = {length} {needed}.")
    return np.broadcast_to(lengths, (n,))


def require_names(kind: str, names: Sequence[str]) -> Formulas:
    """Return names or formulas as a tuple, refusing what is not a list of different ones."""
    listed = isinstance(names, Sequence) and not isinstance(names, str)
    if not listed or not names or not all(isinstance(name, str) and name.strip() for name in names):
        raise ConfigError(f"{kind}: needs a list of names or formulas, found {names!r:.200}.")
    if len(set(names)) != len(names):
        raise ConfigError(f"{kind}: {list(names)} repeat a name; give each once.")
    return tuple(names)


def _is_whole(value: object, least: int) -> bool:
    """Whether a value is a whole number, at least so large and no larger than a double can count."""
    numeric = isinstance(value, int | float | np.number) and not isinstance(value, bool)
    return bool(numeric and least <= value <= 2**53 and int(value) == value)  # type: ignore[operator,call-overload]


def _require_count(kind: str, count: float) -> None:
    if count > MAX_FORMULAS:
        raise ConfigError(f"{kind}: these options make more than {MAX_FORMULAS} formulas; ask for fewer.")


def _require_whole(kind: str, option: str, values: Any, least: int) -> None:
    numbers = list(values) if isinstance(values, Iterable) and not isinstance(values, str) else []
    if not numbers or not all(_is_whole(v, least) for v in numbers) or len(set(numbers)) != len(numbers):
        needed = f"should be different whole numbers of at least {least}"
        raise ConfigError(f"{kind}: {option} = {values!r:.200} {needed}.")
