"""Recordings beside a finished run: opened as those of the run were, with the lifting parameters of every unit."""

from __future__ import annotations

import logging
from collections.abc import Collection, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np

from ...core.errors import ConfigError, DataError, IdentificationError
from ...core.files import read_toml
from ...data import Population, read, split_episodes
from ...data.population import EpisodeKey
from ...data.survey import RecordingFacts
from ...identify import PhaseCalibration
from ...identify.calibration import segments_of
from ...observer import Observer
from ..config import StudyConfig, validate_config
from ..engine.store import Store
from ..stages.read import ARRAYS

log = logging.getLogger(__name__)


def open_data(config: StudyConfig, data: Path, optional: Collection[str] = ()) -> Population:
    """Open a folder with the run's reader, or what a TOML with ``[data]`` names; `optional` channels may be absent."""
    data = Path(data)
    section = config.data
    if data.is_file():
        raw = read_toml(data, "DATA is no folder of recordings, and")
        section = validate_config({"data": raw.get("data", {})}, data.parent, str(data)).data
    else:
        section = section.model_copy(update={"source": data})
    reader = None if section.reader == ARRAYS else section.reader
    try:
        return read(section.source, reader, prepare=section.prepare, mapping=section.csv, optional=optional)
    except (ConfigError, DataError) as error:
        if not data.is_dir() or data.suffix == ".toml":
            raise
        raise type(error)(
            f"{error} Recordings of another kind than the run's are named by a TOML with [data], as in a study."
        ) from error


def hidden_states(observer: Observer) -> tuple[str, ...]:
    """Return the recorded states that are not measured at run time."""
    return tuple(name for i, name in enumerate(observer.recorded) if i not in observer.measured)


def check_channels(population: Population, observer: Observer, *, field_recordings: bool = False) -> None:
    """Refuse other channels, units of measure or sampling periods than those of the run; hidden ones may be absent."""
    expected, found = (observer.recorded, observer.inputs), (population.states, population.inputs)
    needed = (*(observer.lifting.states[i] for i in observer.measured), *observer.inputs)
    missing = [name for name in needed if name not in (*population.states, *population.inputs)]
    if missing and field_recordings:
        there = ", ".join((*population.states, *population.inputs))
        absent = f"{', '.join(missing)} is missing from the recordings, which have {there}"
        raise DataError(
            f"Channels: the observer needs {', '.join(needed)}; {absent}; record it, or correct the mapping."
        )
    if expected != found and not field_recordings:
        both = f"the run has states and inputs {expected}, the recordings {found}"
        raise DataError(f"Channels: {both}; read them the same way.")
    units = observer.about.get("units_of_measure", {})
    for channel in population.channels:
        if channel.unit and units.get(channel.name, channel.unit) not in ("", channel.unit):
            both = f"is in {units[channel.name]!r} in the run and in {channel.unit!r} in the recordings"
            advice = "declare a scale step, or leave the unit out where it is only written differently"
            raise DataError(f"Channels: {channel.name} {both}; {advice}.")
    if not np.isclose(population.sample_period_s, observer.sample_period_s, rtol=1e-6):
        both = f"the run has {observer.sample_period_s} s, the recordings {population.sample_period_s} s"
        raise DataError(f"Sampling period: {both}; declare a resample step.")


def identify_on(store: Store) -> str:
    """Return the condition that feeds synthesis in a run."""
    return RecordingFacts.load(store.path("population")).identify_on


def load_calibration(store: Store) -> PhaseCalibration | None:
    """Return the run's calibration, where it has one."""
    return PhaseCalibration.load(store.path("calibration")) if store.holds("calibration", "calibration.json") else None


@dataclass(frozen=True)
class UnitValues:
    """Lifting parameters of every unit, and where each came from."""

    values: dict[str, dict[str, float]]
    sources: dict[str, str] = field(default_factory=dict)
    reasons: dict[str, str] = field(default_factory=dict)


def unit_values(
    population: Population,
    calibration: PhaseCalibration | None,
    prefer: str,
    given: Mapping[str, Mapping[str, float]] | None = None,
) -> UnitValues:
    """Return every unit's lifting parameters."""
    given = given or {}
    found = UnitValues({unit: dict(given.get(unit, {})) for unit in population.unit_ids})
    if calibration is None:
        return found
    training, parameter = training_keys(population), calibration.spec.parameter
    for unit, values in found.values.items():
        if parameter in values:
            found.sources[unit] = "given"
            continue
        by_condition = {condition: keys for (u, condition), keys in training.items() if u == unit}
        try:
            segments = segments_of(
                (population, by_condition.get(prefer) or next(iter(by_condition.values())), calibration.spec)
            )
            values[parameter], found.sources[unit] = calibration.calibrate(segments, unit).phase_rad, "calibrated"
            if calibration.spec.measured not in population.states:
                found.sources[unit] = f"calibrated on the derivative of {calibration.spec.angle}"
        except IdentificationError as error:
            if unit in calibration.units:
                values[parameter], found.sources[unit] = calibration.units[unit].phase_rad, "of the run"
                log.info("unit %s: its recordings do not show the phase, that of the run is taken", unit)
            else:
                found.sources[unit], found.reasons[unit] = "unknown", str(error)
    return found


def unit_parameters(
    population: Population, calibration: PhaseCalibration | None, prefer: str
) -> dict[str, dict[str, float]]:
    """Return every unit's lifting parameters, as `unit_values` finds them."""
    found = unit_values(population, calibration, prefer)
    for reason in found.reasons.values():
        raise IdentificationError(reason)
    return found.values


def parse_given(texts: Collection[str], units: Collection[str], known: Collection[str]) -> dict[str, dict[str, float]]:
    """Return parameters given as ``UNIT.NAME=VALUE``."""
    given: dict[str, dict[str, float]] = {}
    for text in texts:
        place, _, number = text.partition("=")
        unit, _, name = place.rpartition(".")
        try:
            value = float(number)
        except ValueError:
            value = np.nan
        if unit not in units or name not in known or not np.isfinite(value):
            of = f"a unit of the recordings ({', '.join(sorted(units)[:5])})"
            name_of = f"a parameter of the observer ({', '.join(known) or 'it has none'})"
            raise ConfigError(f"--parameter {text}: should be UNIT.NAME=VALUE with {of}, {name_of} and a number.")
        given.setdefault(unit, {})[name] = value
    return given


def training_keys(population: Population) -> dict[tuple[str, str], tuple[EpisodeKey, ...]]:
    """Return the episodes that a unit is identified on: its training part, or its only episode."""
    groups = {(u, c): keys for u, c, keys in population.groups()}
    single = {group: keys for group, keys in groups.items() if len(keys) < 2}
    several = [group for group in groups if group not in single]
    chosen = replace(population, episodes=tuple(k for group in several for k in groups[group]))
    return single | {group: split.train for group, split in split_episodes(chosen).items()}
