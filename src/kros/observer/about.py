"""What the file of an observer says beside what runs: for those who put it into machines. Nothing computes with it, and it is checked all the same."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from pydantic import Field

from ..core.errors import ConfigError, DataError
from ..core.settings import Settings
from .sensor import Sensor

Interval = tuple[float | None, float | None]


class Column(Settings):
    """``channel[k] = factor * column[k + lag_samples]``, plus what `offset` says; see `kros.data.scaling.Scaling`."""

    column: str | int | None = Field(None, description="name in the header of the recordings, or number from 1; null where units differ")
    factor: float = 1.0
    lag_samples: int = 0
    offset: str = ""


class Trained(Settings):
    """What it was learned from."""

    units: int = Field(ge=1, description="number of units that took part")
    conditions: tuple[str, ...] = ()
    identify_on: str = Field("", description="condition of the models")


class Found(Settings):
    """How a lifting parameter was found in the study, as in `[calibrate]`, and the mean lag that says on which branch a phase is."""

    unit: str = "rad"
    angle: str
    ratio: float
    reference: str
    measured: str
    lag_rad: float


class AsItRuns(Settings):
    """The certificate as it runs."""

    certified: bool
    reason: str = ""
    gain: float | None = None
    operating_box: dict[str, Interval] = Field(
        {}, description="ranges that true and estimated signals have to stay in; none where it holds everywhere"
    )
    assumptions: tuple[str, ...] = ()


class RecordedSignals(Settings):
    """The bound for signals like those recorded."""

    certified: bool
    reason: str = ""
    bound_percent: dict[str, float | None] = Field({}, description="largest RMS of the error by state, percent of its range")
    outside: tuple[str, ...] = Field((), description="units whose own recordings are outside")


class Losses(Settings):
    """The bound for measurements that are lost at random."""

    rate: float
    certified: bool
    mean_square_gain: float | None = None
    reason: str = ""


class UncertainSet(Settings):
    """The certificate on the uncertain set."""

    worst_case_h2: float | None = None
    reason: str = ""


class About(Settings):
    """The object ``about`` of an observer's file; every part of it may be absent."""

    kros: str = Field("", description="version that made it")
    study: str = ""
    units_of_measure: dict[str, str] = Field({}, description="by channel")
    largest_in_training: dict[str, float] = Field({}, description="largest absolute value of every channel in training")
    columns: dict[str, Column] = Field({}, description="where measurements and inputs came from in the recordings")
    sensor: dict[str, Sensor] = Field({}, description="what is assumed of the sensors: declared, and the resolution that was found")
    parameters: dict[str, Found] = Field({}, description="how the study found lifting parameters")
    trained_on: Trained | None = None
    as_it_runs: AsItRuns | None = None
    recorded_signals: RecordedSignals | None = None
    losses: Losses | None = None
    uncertain_set: UncertainSet | None = None


def checked_about(found: Any, states: Sequence[str], inputs: Sequence[str], parameters: Sequence[str], where: str) -> dict[str, Any]:
    """Return what a file says, with the channels that it speaks of checked against those of the observer."""
    if not isinstance(found, Mapping):
        raise DataError(f"{where} should be an object, found {found!r}; correct the file.")
    try:
        own = About.of(found, where)
    except ConfigError as error:
        raise DataError(f"{error} Correct the file.") from error
    channels = {name: (*states, *inputs) for name in ("units_of_measure", "largest_in_training", "columns", "sensor")}
    for key, known in (channels | {"parameters": tuple(parameters)}).items():
        if unknown := [name for name in getattr(own, key) if name not in known]:
            raise DataError(f"{where}.{key}: {unknown[0]!r} is none of {', '.join(known)}; correct the file.")
    return dict(found)
