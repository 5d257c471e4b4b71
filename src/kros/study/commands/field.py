"""Recordings beside a finished run: opened as those of the run were, with parameters of every unit, and estimates."""

from __future__ import annotations

import logging
import math
from collections.abc import Collection, Iterable, Iterator, Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property
from itertools import chain
from pathlib import Path

import numpy as np
import numpy.typing as npt

from ...core.errors import ConfigError, DataError, IdentificationError
from ...core.files import read_toml
from ...data import Population, read, split_episodes
from ...data.population import EpisodeKey
from ...data.prepare import with_gaps
from ...data.survey import RecordingFacts
from ...evaluate.sensor import Arriving, arriving
from ...identify import PhaseCalibration
from ...identify.calibration import segments_of
from ...observer import Observer
from ...observer.screen import Bits, SampleStatus
from ...observer.simulate import Course
from ...observer.tracking import PhaseLockedLoop, least_innovation
from ..config import StudyConfig, validate_config
from ..engine.store import Store
from ..stages.read import ARRAYS

log = logging.getLogger(__name__)
Array = npt.NDArray[np.float64]
Values = dict[str, dict[str, float]]  # lifting parameters by unit
# Episode, first sample, columns of estimates and of the tracked parameter, bits: of an episode or a block of it
Estimated = tuple[EpisodeKey, int, Array, Bits]
DEPLOYED = ("observers", "deployed.json")
_BATCH, _SAMPLES, _BLOCK = 64, 200_000, 50_000  # episodes at a time, their samples, and samples of one that is longer


def open_data(config: StudyConfig, data: Path, optional: Collection[str] = ()) -> Population:
    """Open a folder with the run's reader, or what a TOML with ``[data]`` names; `optional` channels may be absent."""
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
        other = "Recordings of another kind than the run's are named by a TOML with [data], as in a study."
        raise type(error)(f"{error} {other}") from error


def hidden_states(observer: Observer) -> tuple[str, ...]:
    """Return the recorded states that are not measured at run time."""
    return tuple(name for i, name in enumerate(observer.recorded) if i not in observer.measured)


def check_channels(population: Population, observer: Observer, *, hidden: bool = True) -> None:
    """Refuse other channels, units of measure or sampling periods than those of the run, perhaps of hidden states."""
    expected, there = (observer.recorded, observer.inputs), (population.states, population.inputs)
    needed = (*(observer.lifting.states[i] for i in observer.measured), *observer.inputs)
    names = [*population.states, *population.inputs]
    if not hidden and (missing := [name for name in needed if name not in names]):
        absent = f"{', '.join(missing)} is missing from the recordings, which have {', '.join(names)}"
        raise DataError(
            f"Channels: the observer needs {', '.join(needed)}; {absent}; record it, or correct the mapping."
        )
    if hidden and expected != there:
        both = f"the run has states and inputs {expected}, the recordings {there}"
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


def training_keys(population: Population) -> dict[tuple[str, str], tuple[EpisodeKey, ...]]:
    """Return the episodes that a unit is identified on: its training part, or its only episode."""
    groups = {(u, c): keys for u, c, keys in population.groups()}
    several = tuple(k for keys in groups.values() if len(keys) > 1 for k in keys)
    splits = split_episodes(replace(population, episodes=several))
    return groups | {group: split.train for group, split in splits.items()}


@dataclass(frozen=True)
class UnitValues:
    """Lifting parameters of every unit, where each came from, and why one is unknown."""

    values: Values
    sources: dict[str, str] = field(default_factory=dict)
    reasons: dict[str, str] = field(default_factory=dict)


def unit_values(
    population: Population, calibration: PhaseCalibration | None, prefer: str, given: Values | None = None
) -> UnitValues:
    """Return every unit's lifting parameters: given, calibrated in a condition, or those of the run."""
    units = UnitValues({unit: dict((given or {}).get(unit, {})) for unit in population.unit_ids})
    if calibration is None:
        return units
    training, spec = training_keys(population), calibration.spec
    derived = "" if spec.measured in population.states else f" on the derivative of {spec.angle}"
    for unit, values in units.values.items():
        if spec.parameter in values:
            units.sources[unit] = "given"
            continue
        by_condition = {condition: keys for (u, condition), keys in training.items() if u == unit}
        try:
            keys = by_condition.get(prefer) or next(iter(by_condition.values()))
            phase = calibration.calibrate(segments_of((population, keys, spec)), unit)
            units.sources[unit] = f"calibrated{derived}"
        except IdentificationError as error:
            if unit not in calibration.units:
                units.sources[unit], units.reasons[unit] = "unknown", str(error)
                continue
            phase, units.sources[unit] = calibration.units[unit], "of the run"
            log.info("unit %s: its recordings do not show the phase, that of the run is taken", unit)
        values[spec.parameter] = phase.phase_rad
    return units


def unit_parameters(population: Population, calibration: PhaseCalibration | None, prefer: str) -> Values:
    """Return every unit's lifting parameters, as `unit_values` finds them; refuse one that is unknown."""
    units = unit_values(population, calibration, prefer)
    for reason in units.reasons.values():
        raise IdentificationError(reason)
    return units.values


def parse_given(texts: Collection[str], units: Collection[str], known: Collection[str]) -> Values:
    """Return parameters given as ``UNIT.NAME=VALUE``."""
    given: Values = {}
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


@dataclass(frozen=True)
class FieldRecordings:
    """Recordings that need no hidden channels, with all that the observer needs to run on them."""

    observer: Observer
    population: Population
    values: Values
    sources: Mapping[str, str] = field(default_factory=dict)
    followed: frozenset[str] = frozenset()  # units whose parameter is followed
    name: str | None = None  # of that parameter

    @classmethod
    def open(
        cls, config: StudyConfig, store: Store, data: Path, given: Collection[str] = (), track: str | None = None
    ) -> FieldRecordings:
        """Open what `data` names, and settle the parameters of every unit."""
        if not store.holds(*DEPLOYED):
            raise ConfigError(f"Run {store.folder}: has no deployed observer; run the study at least until synthesize.")
        observer = Observer.load(store.path(*DEPLOYED))
        known = observer.lifting.parameters
        if track is not None and track not in known:
            raise ConfigError(f"--track {track}: the observer's parameters are {', '.join(known) or 'none'}.")
        population = with_gaps(open_data(config, data, hidden_states(observer)))
        check_channels(population, observer, hidden=False)
        calibration = load_calibration(store)
        units = unit_values(population, calibration, identify_on(store), parse_given(given, population.unit_ids, known))
        phase = None if calibration is None else calibration.spec.parameter
        return cls(observer, population, units.values, units.sources)._tracking(units.reasons, track, phase)

    def _tracking(self, reasons: Mapping[str, str], track: str | None, phase: str | None) -> FieldRecordings:
        """Return the same with parameters that are followed, by option or since they are unknown."""
        unknown = {u: [p for p in self.observer.lifting.parameters if p not in v] for u, v in self.values.items()}
        name = track or next((p for missing in unknown.values() for p in missing), "")
        values, sources, followed = {u: dict(v) for u, v in self.values.items()}, dict(self.sources), set[str]()
        for unit, missing in unknown.items():
            if track is None and not missing:
                continue
            if set(missing) - {name} or not _trackable(self.observer, name):
                reason = reasons.get(unit, "it was not calibrated.")
                loop = "a phase-locked loop either, which needs one unknown parameter and an observer without delays"
                follow = f"It cannot be followed by {loop}; give it, --parameter {unit}.{name}=VALUE."
                raise IdentificationError(f"Parameter {', '.join(missing) or name} of unit {unit}: {reason} {follow}")
            source = f"value that is {sources.get(unit)}"
            if name in missing:
                source = "value of the smallest innovation" if name == phase else "value of the nominal unit"
            if name in missing and name == phase:
                values[unit][name] = self._start(unit, name)
            sources[unit] = f"tracked from the {source}"
            followed.add(unit)
        return replace(self, values=values, sources=sources, followed=frozenset(followed), name=name or None)

    def _start(self, unit: str, name: str, phases: int = 24, samples: int = 20_000) -> float:
        """Return the phase at which the observer's innovation is smallest in the first episodes of a unit."""
        chosen, values = dict[EpisodeKey, Array](), self.values[unit]
        for key in self.population.keys(unit)[:_BATCH]:
            if sum(map(len, chosen.values())) < samples:
                chosen[key] = next(self.population.blocks(key, samples))
        arrived = arriving(self.observer, self.population, chosen, {unit: values})
        step, known = 2 * np.pi / phases, {**self.observer.parameters, **values}
        signals = (self.observer, arrived.y, arrived.u, arrived.batch.lengths, known, name)
        coarse = least_innovation(*signals, np.arange(phases) * step)
        return float(np.mod(least_innovation(*signals, coarse + np.linspace(-1, 1, 9) * step), 2 * np.pi))

    @cached_property
    def _parameters(self) -> Values:
        return {u: {**self.observer.parameters, **known} for u, known in self.values.items()}

    def batches(self, keys: tuple[EpisodeKey, ...]) -> Iterator[Arriving]:
        """Read episodes, long ones one by one, so that memory does not grow with their number."""
        start, count = 0, 1
        while start < len(keys):
            episodes = {key: self.population.read(key) for key in keys[start : start + count]}
            batch = arriving(self.observer, self.population, episodes, self._parameters)
            start, count = start + count, min(_BATCH, max(1, _SAMPLES // len(batch.y)))
            yield batch

    def estimates(self) -> Iterator[Estimated]:
        """Run the observer over all episodes: short ones side by side, long ones in blocks."""
        short: dict[EpisodeKey, Array] = {}
        for key in self.population.episodes:
            blocks = self.population.blocks(key, _BLOCK)
            first, second = next(blocks), next(blocks, None)
            full = (len(short) + 1) * max(len(first), *map(len, short.values()), 0) > _SAMPLES or len(short) == _BATCH
            others = any((key.unit in self.followed) != (other.unit in self.followed) for other in short)
            if short and (second is not None or full or others):
                yield from self._run(tuple(short), [list(short.values())])
                short = {}
            if second is None:
                short[key] = first
            else:
                yield from self._run((key,), ([block] for block in chain((first, second), blocks)))
        if short:
            yield from self._run(tuple(short), [list(short.values())])

    def _run(self, keys: tuple[EpisodeKey, ...], blocks: Iterable[list[Array]]) -> Iterator[Estimated]:
        """Run over episodes, block by block, each behind the samples that late measurements are read from."""
        observer, n, start, course = self.observer, len(self.observer.recorded), 0, None
        loop = PhaseLockedLoop(observer, str(self.name), len(keys)) if keys[0].unit in self.followed else None
        late = math.ceil(max((s.delay_samples for s in observer.sensor.values()), default=0))
        before = [np.empty((0, len(self.population.channels)))] * len(keys)
        for block in blocks:
            values, lead = [np.concatenate(pair) for pair in zip(before, block, strict=True)], len(before[0])
            arrived = arriving(observer, self.population, dict(zip(keys, values, strict=True)), self._parameters)
            course = course or Course(observer, len(keys), arrived.parameters(observer), loop)
            run = course.take(arrived.y[lead:], arrived.u[lead:])
            columns = run.estimates[..., :n]
            if self.name is not None:
                known = arrived.batch.parameters[self.name] if loop is None else run.followed
                columns = np.concatenate([columns, np.broadcast_to(known, columns.shape[:2])[..., None]], axis=-1)
            for i, key in enumerate(keys):
                yield key, start, columns[: len(block[i]), i], run.status[: len(block[i]), i]
            start, before = start + len(block[0]), [part[max(0, len(part) - late) :] for part in values]


def count_status(counts: dict[str, int], status: Bits) -> None:
    """Add to the samples that are missing, invalid, beyond limits, or restart the observer."""
    for bit in SampleStatus:
        if number := int(np.count_nonzero(status & bit)):
            counts[str(bit.name)] = counts.get(str(bit.name), 0) + number


def _trackable(observer: Observer, name: str) -> bool:
    try:
        PhaseLockedLoop(observer, name, 1)
    except ConfigError:
        return False
    return True
