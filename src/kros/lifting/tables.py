"""Families as tables of a study, ``[[lifting.families]]``: the kind chooses the function, the other keys are its arguments."""

from __future__ import annotations

import inspect
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np
import numpy.typing as npt

from ..core.errors import ConfigError
from .families import MAX_FORMULAS, Formulas, delays, harmonics, is_whole, polynomials, require_names
from .kernels import fourier_features, kmeans_centres, radial

Array = npt.NDArray[np.float64]
Table = Mapping[str, Any]
Sample = Callable[[tuple[str, ...]], Array]

KINDS: dict[str, Callable[..., Formulas]] = {
    "harmonics": harmonics,
    "polynomials": polynomials,
    "radial": radial,
    "fourier": fourier_features,
    "delays": delays,
}
CENTRES: dict[str, Callable[..., Array]] = {"kmeans": kmeans_centres}


def family(table: Table, sample: Sample | None = None) -> Formulas:
    """Return the formulas of a family given as a table."""
    arguments = dict(table)
    if isinstance(arguments.get("centres"), Mapping):
        given = arguments["centres"]
        if given.get("kind") == "kmeans" and sample is not None:
            given = {**given, "data": sample(require_names("centres", arguments.get("names", ())))}
        arguments["centres"] = _call("centres", CENTRES, given)
    return tuple(_call("family", KINDS, arguments))


def check_family(table: Table) -> None:
    """Refuse what can be refused without data."""
    centres = table.get("centres")
    if isinstance(centres, Mapping) and centres.get("kind") == "kmeans":
        names = table.get("names", ())
        width = len(names) if isinstance(names, list | tuple) else 1
        if "data" in centres:
            raise ConfigError("Lifting centres 'kmeans': unknown key 'data'; the data are those of the study.")
        count = centres.get("n", 1)
        points = np.random.default_rng(0).normal(
            size=(int(count) if is_whole(count, 1) and count <= MAX_FORMULAS else 1, width)
        )
        family(table, lambda _: points)
    else:
        family(table)


def _call(what: str, kinds: Mapping[str, Callable[..., Any]], table: Table) -> Any:
    arguments = dict(table)
    kind = arguments.pop("kind", None)
    if not isinstance(kind, str) or kind not in kinds:
        raise ConfigError(f"Lifting {what}: kind = {kind!r} is unknown; known are {', '.join(kinds)}.")
    function = kinds[kind]
    known = inspect.signature(function).parameters
    unknown = [key for key in arguments if key not in known]
    missing = [key for key, p in known.items() if p.default is p.empty and key not in arguments]
    if unknown or missing:
        problems = [f"unknown key {k!r}" for k in unknown] + [f"{k!r} is missing" for k in missing]
        raise ConfigError(f"Lifting {what} {kind!r}: {', '.join(problems)}; it takes {', '.join(known)}.")
    try:
        return function(**arguments)
    except (TypeError, ValueError, ArithmeticError, AttributeError) as error:
        if isinstance(error, ConfigError):
            raise
        raise ConfigError(f"Lifting {what} {kind!r}: {error}; check {table!s:.500}.") from error
