"""Units of measure: an observer for signals divided by other sizes, and the units of the recordings.

An observer works in the channels' units, and its file says by which factor every channel was multiplied when the files
were read: generated code and `kros estimate` use the units of the files that a study read.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, TypeVar

import numpy as np

from ..core import ROUNDING, TINY, Array, DataError, StateSpace, shortened
from ..data.measures import unit_of_factor
from ..synthesis.result import Injection
from .data import ObserverData
from .sensor import in_units

O = TypeVar("O", bound=ObserverData)  # noqa: E741


def in_sizes(observer: O, sizes: Mapping[str, float]) -> O:
    """Return the observer for states and inputs divided by sizes."""
    lifting = observer.lifting.in_sizes(sizes)
    x, u = factors(observer, sizes)
    y, K = x[list(observer.measured)], observer.controller
    into = u if observer.injection is Injection.INPUT else x
    by: dict[str, dict[str, Array]] = {
        "seen": {"measured": y, "inputs": u[: len(observer.inputs)]},
        "monitor": {"size": y},
        "bank": {
            "start": x[: lifting.n_states, None] / np.concatenate([x, u]),
            "half": x[: len(observer.recorded)],
            **dict.fromkeys(("reach", "noise", "rest", "gate"), y),
        },
        "guard": dict.fromkeys(("lower", "upper"), x[: lifting.n_states]),
        "runtime": dict.fromkeys(observer.runtime.by_state(), x[: lifting.n_states]),
    }
    parts = {name: part for name in by if (part := getattr(observer, name)) is not None}
    changed = {
        name: replace(p, **{key: getattr(p, key) * v for key, v in by[name].items()}) for name, p in parts.items()
    }
    return replace(
        observer,
        lifting=lifting,
        A=observer.A * x[:, None] / x,
        B=observer.B * x[:, None] / u,
        controller=StateSpace(K.A, K.B / y, K.C * into[:, None], K.D * into[:, None] / y, K.dt),
        sensor=in_units(observer.sensor, dict(zip(observer.outputs, (1 / y).tolist(), strict=True))),
        **changed,
    )


def factors(observer: ObserverData, sizes: Mapping[str, float]) -> tuple[Array, Array]:
    """Return what lifted states and inputs are multiplied by where other sizes take the place of an observer's own."""
    old, new = observer.lifting, observer.lifting.in_sizes(sizes)
    inputs = (*observer.inputs, *old.input_functions)
    x, u = (old.sizes_of(names) / new.sizes_of(names) for names in (old.names, inputs))
    if observer.bank is not None:  # its last states have the units of the recorded ones
        n, recorded = old.n_states, len(observer.recorded)
        x[n - 2 * recorded : n] = np.tile(x[:recorded], 2)
    return x, u


@dataclass(frozen=True)
class RecordedChannel:
    """A channel as it stands in the recordings: one of its `unit` is `factor` of the channel's own unit."""

    factor: float = 1.0
    unit: str = ""
    note: str = ""  # what else was done to it on reading


def recorded_channel(observer: ObserverData, name: str) -> RecordedChannel:
    """Return how a channel stands in the recordings; one that the file does not name is as it is."""
    units, columns = (observer.about.get(key, {}) for key in ("units_of_measure", "columns"))
    own = columns.get(name, {}) if isinstance(columns, dict) else columns
    unit = units.get(name, "") if isinstance(units, dict) else units
    if not isinstance(own, dict) or not isinstance(unit, str):
        raise DataError(
            f"Observer {observer.name}: about.columns and about.units_of_measure should be objects; correct the file."
        )
    factor, converted = (_factor(observer, name, own.get(key, 1.0)) for key in ("factor", "converted"))
    lag, offset = own.get("lag_samples", 0), own.get("offset", "")
    late = f"the column comes {lag} samples late" if lag else ""
    note = ", ".join(filter(None, (late, f"added: {offset}" if offset else "")))
    factor = factor if converted == 1.0 else factor / converted
    if math.isclose(factor, 1.0, rel_tol=ROUNDING):
        return RecordedChannel(1.0, unit, note)
    return RecordedChannel(factor, unit_of_factor(factor, unit) or f"{factor:.6g} {unit or 'of the study'}", note)


def recorded_factors(observer: ObserverData, names: Sequence[str]) -> Array:
    """Return the factor of every channel: its value is the factor times the recorded one."""
    return np.array([recorded_channel(observer, name).factor for name in names])


def _factor(observer: ObserverData, name: str, value: Any) -> float:
    """Return a factor that a number of the file can be."""
    number = isinstance(value, int | float) and not isinstance(value, bool)
    if not number or not abs(value) < 1 / TINY or not abs(value) > TINY:
        raise DataError(
            f"Observer {observer.name}: the factor of {name!r} should be a finite number other than zero, found "
            f"{shortened(repr(value), 60)}; correct about.columns of its file."
        )
    return float(value)
