"""Recordings beside a finished run, with parameters of every unit, and `kros estimate`, in the recordings' units."""

from __future__ import annotations

import json
import logging
import math
from collections import Counter, defaultdict
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from functools import cached_property
from itertools import chain
from pathlib import Path
from typing import Any

import numpy as np

from ...core.arrays import Array, Bits
from ...core.artifacts import write_json
from ...core.errors import ConfigError, DataError, IdentificationError
from ...core.files import read_toml
from ...core.rounding import AGREED
from ...data import Population, read, split_episodes
from ...data.population import EpisodeKey
from ...data.prepare import with_gaps
from ...evaluate.sensor import Arriving, arriving
from ...identify import PhaseCalibration
from ...identify.calibration import segments_of
from ...identify.survey import RecordingFacts
from ...observer import Observer
from ...observer.screen import SampleStatus
from ...observer.simulate import Course
from ...observer.tracking import PhaseLockedLoop, least_innovation
from ...observer.units import recorded_channel, recorded_factors
from ..config import Stage, StudyConfig, validate_config
from ..engine.store import Store, open_finished
from ..stages.learning import ARRAYS

log = logging.getLogger(__name__)
Values = dict[str, dict[str, float]]  # lifting parameters by unit
Texts = dict[str, str]  # by unit
# Episode, first sample, columns of estimates and of the tracked parameter, bits: of an episode or a block of it
Estimated = tuple[EpisodeKey, int, Array, Bits]
DEPLOYED = ("observers", "deployed.json")
_BLOCK = 20_000  # samples of an episode that are run at once
_BATCH = 20  # shorter episodes that run side by side


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
    needed = (*observer.outputs, *observer.inputs)
    names = [*population.states, *population.inputs]
    if not hidden and (missing := [name for name in needed if name not in names]):
        absent = f"{', '.join(missing)} is missing, which the observer reads; there are {', '.join(names)}"
        raise DataError(f"Channels: {absent}; record it, or correct the mapping.")
    if hidden and expected != there:
        both = f"the run has states and inputs {expected}, the recordings {there}"
        raise DataError(f"Channels: {both}; read them the same way.")
    units = observer.about.get("units_of_measure", {})
    for channel in population.channels:
        if channel.unit and units.get(channel.name, channel.unit) not in ("", channel.unit):
            both = f"is in {units[channel.name]!r} in the run and in {channel.unit!r} in the recordings"
            advice = "declare a scale step, or leave the unit out where it is only written differently"
            raise DataError(f"Channels: {channel.name} {both}; {advice}.")
    if not np.isclose(population.sample_period_s, observer.sample_period_s, rtol=AGREED):
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


def unit_values(
    population: Population, calibration: PhaseCalibration | None, prefer: str, given: Values | None = None
) -> tuple[Values, Texts, Texts]:
    """Return the lifting parameters of units, where each came from, and why one is unknown.

    They are given, calibrated in a condition, or those of the run.
    """
    known, sources, reasons = {u: dict((given or {}).get(u, {})) for u in population.unit_ids}, Texts(), Texts()
    if calibration is None:
        return known, sources, reasons
    training, spec = training_keys(population), calibration.spec
    derived = "" if spec.measured in population.states else f" on the derivative of {spec.angle}"
    for unit, values in known.items():
        if spec.parameter in values:
            sources[unit] = "given"
            continue
        by_condition = {condition: keys for (u, condition), keys in training.items() if u == unit}
        keys = by_condition.get(prefer) or next(iter(by_condition.values()))
        try:
            phase = calibration.calibrate(segments_of((population, keys, spec)), unit)
            sources[unit] = f"calibrated{derived}"
        except IdentificationError as error:
            if unit not in calibration.units:
                sources[unit], reasons[unit] = "unknown", str(error)
                continue
            phase, sources[unit] = calibration.units[unit], "of the run"
            log.info("unit %s: its recordings do not determine the phase; the value of the run is used", unit)
        values[spec.parameter] = phase.phase_rad
    return known, sources, reasons


def unit_parameters(population: Population, calibration: PhaseCalibration | None, prefer: str) -> Values:
    """Return every unit's lifting parameters, as `unit_values` finds them; refuse one that is unknown."""
    values, _, reasons = unit_values(population, calibration, prefer)
    for reason in reasons.values():
        raise IdentificationError(reason)
    return values


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
    name: str | None = None  # of the parameter that a phase-locked loop follows

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
        chosen = parse_given(given, population.unit_ids, known)
        values, sources, reasons = unit_values(population, load_calibration(store), identify_on(store), chosen)
        return cls(observer, population, values, sources, track)._settled(reasons)

    def _settled(self, reasons: Texts) -> FieldRecordings:
        """Return the same with all parameters that the observer needs; one that is followed begins anywhere."""
        values, sources = {unit: dict(known) for unit, known in self.values.items()}, dict(self.sources)
        for unit, known in values.items():
            missing = [name for name in self.observer.lifting.parameters if name not in known]
            if set(missing) - {self.name}:
                reason, first = reasons.get(unit, "it was not calibrated."), missing[0]
                advice = f"Give it, --parameter {unit}.{first}=VALUE, or let it be followed, --track {first}."
                raise IdentificationError(f"Parameter {', '.join(missing)} of unit {unit}: {reason} {advice}")
            if self.name is not None:
                known[self.name] = self._start(unit, self.name) if missing else known[self.name]
                start = "of the smallest innovation" if missing else f"that is {sources.get(unit)}"
                sources[unit] = f"tracked from the value {start}"
        return replace(self, values=values, sources=sources)

    def _start(self, unit: str, name: str, phases: int = 24) -> float:
        """Return the phase at which the observer's innovation is smallest in the first episodes of a unit."""
        chosen, values = dict[EpisodeKey, Array](), self.values[unit]
        for key in self.population.keys(unit)[:_BATCH]:
            if sum(map(len, chosen.values())) < _BLOCK:
                chosen[key] = next(self.population.blocks(key, _BLOCK))
        arrived = arriving(self.observer, self.population, chosen, {unit: values})
        step, known = 2 * np.pi / phases, {**self.observer.parameters, **values}
        signals = (self.observer, arrived.y, arrived.u, arrived.batch.lengths, known, name)
        coarse = least_innovation(*signals, np.arange(phases) * step)
        return float(np.mod(least_innovation(*signals, coarse + np.linspace(-1, 1, 9) * step), 2 * np.pi))

    @cached_property
    def _parameters(self) -> Values:
        return {u: {**self.observer.parameters, **known} for u, known in self.values.items()}

    def arriving(self, key: EpisodeKey) -> Arriving:
        """Read one episode as it arrives at the observer."""
        return arriving(self.observer, self.population, {key: self.population.read(key)}, self._parameters)

    def estimates(self) -> Iterator[Estimated]:
        """Run the observer over all episodes: short ones side by side, long ones in blocks."""
        short: dict[EpisodeKey, Array] = {}
        for key in self.population.episodes:
            blocks = self.population.blocks(key, _BLOCK)
            first, second = next(blocks), next(blocks, None)
            if short and (second is not None or len(short) == _BATCH):
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
        loop = None if self.name is None else PhaseLockedLoop(observer, self.name, len(keys))
        late = math.ceil(max((s.delay_samples for s in observer.sensor.values()), default=0))
        before = [np.empty((0, len(self.population.channels)))] * len(keys)
        for block in blocks:
            values, lead = [np.concatenate(pair) for pair in zip(before, block, strict=True)], len(before[0])
            arrived = arriving(observer, self.population, dict(zip(keys, values, strict=True)), self._parameters)
            course = course or Course(observer, len(keys), arrived.parameters(observer), loop)
            run = course.take(arrived.y[lead:], arrived.u[lead:])
            columns = run.estimates[..., :n]
            if loop is not None:
                followed = np.broadcast_to(run.followed, columns.shape[:2])
                columns = np.concatenate([columns, followed[..., None]], axis=-1)
            for i, key in enumerate(keys):
                yield key, start, columns[: len(block[i]), i], run.status[: len(block[i]), i]
            start, before = start + len(block[0]), [part[max(0, len(part) - late) :] for part in values]


def status_counts(status: Bits) -> Counter[str]:
    """Return how many samples are missing, invalid, beyond limits, or restart the observer."""
    return +Counter({str(bit.name): int(np.count_nonzero(status & bit)) for bit in SampleStatus})


Write = Callable[[EpisodeKey, int, Array], None]
ENDINGS = (".parquet", ".csv")
KEYS = ("unit", "condition", "episode", "k")


def estimate_recordings(
    run: Path, data: Path, out: Path, given: Collection[str] = (), track: str | None = None
) -> list[str]:
    """Write ``unit, condition, episode, k, <channel>_hat`` for every sample, then the parameter that is followed.

    Return what people read at the terminal.
    """
    with open_finished(run, Stage.READ, Stage.CALIBRATE, Stage.SYNTHESIZE) as (config, store):
        if out.exists() or out.suffix not in ENDINGS:
            raise ConfigError(f"Output {out}: should be a new file that ends in {' or '.join(ENDINGS)}.")
        recordings = FieldRecordings.open(config, store, data, given, track)
        counts = defaultdict[str, Counter[str]](Counter)
        with writer(out, facts_of(recordings)) as write:
            factors = recorded_factors(recordings.observer, recordings.observer.recorded)
            for key, start, columns, status in recordings.estimates():
                columns[:, : len(factors)] /= factors
                write(key, start, columns)
                counts[key.unit].update(status_counts(status))
    count = len(recordings.population.episodes)
    return [f"estimates of {count} episode{'s' * (count != 1)} in {out}", *unit_lines(recordings.sources, counts)]


def unit_lines(sources: Mapping[str, str], counts: Mapping[str, Mapping[str, int]]) -> list[str]:
    """Return a line a unit with the source of its parameters and its samples by status, where there is any."""
    lines = []
    for unit in dict.fromkeys([*sources, *(u for u, of_unit in counts.items() if of_unit)]):
        parts = [f"parameters {sources[unit]}"] if unit in sources else []
        parts += [f"{count} samples {bit}" for bit, count in counts.get(unit, {}).items()]
        lines.append(f"  unit {unit}: {'; '.join(parts)}")
    return lines


def facts_of(recordings: FieldRecordings) -> dict[str, Any]:
    """Return the observer, columns with their units of measure, and parameters of every unit with their sources."""
    observer, name = recordings.observer, recordings.name
    columns = {f"{s}_hat": recorded_channel(observer, s).unit for s in observer.recorded}
    columns |= {} if name is None else {name: "rad"}
    parameters = {u: {**recordings.values[u], "source": source} for u, source in recordings.sources.items()}
    about = {key: observer.about.get(key) for key in ("kros", "study")}
    return {"observer": observer.name, **about, "columns": columns, "parameters": parameters}


@contextmanager
def writer(out: Path, facts: dict[str, Any]) -> Iterator[Write]:
    """Give a function that writes an episode's estimates from a sample on; the file appears whole or not at all."""
    import pyarrow as pa
    from pyarrow import csv, parquet

    labels = [pa.field(name, pa.int64() if name == "k" else pa.string()) for name in KEYS]
    units = {name: {"unit": unit} if unit else None for name, unit in facts["columns"].items()}
    columns = [pa.field(name, pa.float64(), metadata=unit) for name, unit in units.items()]
    about = {n: v if isinstance(v, str) else json.dumps(v) for n, v in facts.items() if v is not None}
    schema, text = pa.schema([*labels, *columns], metadata=about), out.suffix == ".csv"
    out.parent.mkdir(parents=True, exist_ok=True)
    temporary = out.with_name(f".{out.name}.partial")
    try:
        with (
            csv.CSVWriter(temporary, schema)
            if text
            else parquet.ParquetWriter(temporary, schema, write_page_checksum=True)
        ) as file:

            def write(key: EpisodeKey, start: int, values: Array) -> None:
                names = [pa.repeat(name, len(values)) for name in (key.unit, key.condition, key.episode)]
                samples = pa.array(np.arange(start, start + len(values)))
                numbers = [pa.array(np.ascontiguousarray(column)) for column in values.T]
                file.write_table(pa.Table.from_arrays([*names, samples, *numbers], schema=schema), max(len(values), 1))

            yield write
        if text:
            write_json(out.with_name(f"{out.name}-metadata.json"), facts)
        temporary.replace(out)
    finally:
        temporary.unlink(missing_ok=True)
