"""Units of the recordings: generated code and `kros estimate` take and give what stands in the files that a study read.

An observer works in the channels' units, and its file says by which factor every channel was multiplied when the files were read.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from ..core.errors import DataError
from ..core.files import shortened
from ..data.discovery.roles import unit_of_factor
from .data import ObserverData


@dataclass(frozen=True)
class RecordedChannel:
    """A channel as it stands in the recordings: one of its `unit` is `factor` of the channel's own unit."""

    factor: float = 1.0
    unit: str = ""
    note: str = ""  # what else was done to it on reading


def recorded_channel(observer: ObserverData, name: str) -> RecordedChannel:
    """Return how a channel stands in the recordings, by the observer's file; one that the file does not name is as the observer has it."""
    units, columns = (observer.about.get(key, {}) for key in ("units_of_measure", "columns"))
    own = columns.get(name, {}) if isinstance(columns, dict) else columns
    unit = units.get(name, "") if isinstance(units, dict) else units
    if not isinstance(own, dict) or not isinstance(unit, str):
        raise DataError(
            f"Observer {observer.name}: about.columns and about.units_of_measure should be objects; correct the file."
        )
    factor, converted = (_factor(observer, name, own.get(key, 1.0)) for key in ("factor", "converted"))
    lag, offset = own.get("lag_samples", 0), own.get("offset", "")
    note = ", ".join(
        [*([f"the column comes {lag} samples late"] if lag else []), *([f"added: {offset}"] if offset else [])]
    )
    factor = factor if converted == 1.0 else factor / converted
    if math.isclose(factor, 1.0, rel_tol=1e-12):
        return RecordedChannel(1.0, unit, note)
    return RecordedChannel(factor, unit_of_factor(factor, unit) or f"{factor:.6g} {unit or 'of the study'}", note)


def recorded_factors(observer: ObserverData, names: Sequence[str]) -> npt.NDArray[np.float64]:
    """Return the factor of every channel: its value is the factor times what stands in the recordings."""
    return np.array([recorded_channel(observer, name).factor for name in names])


def _factor(observer: ObserverData, name: str, value: Any) -> float:
    """Return a factor that a number of the file can be."""
    number = isinstance(value, (int, float)) and not isinstance(value, bool)
    if not number or not abs(value) < 1e300 or not abs(value) > 1e-300:
        raise DataError(
            f"Observer {observer.name}: the factor of {name!r} should be a finite number other than zero, found "
            f"{shortened(repr(value), 60)}; correct about.columns of its file."
        )
    return float(value)
