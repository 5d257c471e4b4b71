"""Recordings beside a finished run: their channels, parameters of every unit, and the deployed observer on them."""

from __future__ import annotations

from collections import Counter
from collections.abc import Collection, Iterator
from dataclasses import field, replace
from pathlib import Path

import numpy as np

from ...core import (
    AGREED,
    Array,
    Bits,
    ConfigError,
    DataError,
    IdentificationError,
    Names,
    did_you_mean,
    frozen,
    read_toml,
)
from ...core.linalg import pieces
from ...data import EpisodeKey, Population, read, some
from ...data.prepare import with_gaps
from ...evaluate.sensor import Arriving, arriving
from ...identify.calibration import Texts, Values, unit_values
from ...observer import Observer, SampleStatus
from ...observer.simulate import Course
from ...observer.tracking import PhaseLockedLoop, least_innovation
from ..config import StudyConfig, validate_config
from ..engine.context import Context
from ..engine.store import DEPLOYED
from ..stages.learning import ARRAYS
from ..stages.load import LOAD

# Episode, first sample, estimates and the tracked parameter, bits, what was recorded: of an episode or a block of it
Estimated = tuple[EpisodeKey, int, Array, Bits, Array]
_BLOCK = 20_000  # samples of an episode that are run at once
_PHASES = 24  # values that are tried, around the circle
_BATCH = 20  # shorter episodes that run side by side


def open_data(config: StudyConfig, data: Path, optional: Collection[str]) -> Population:
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
        hint = "Recordings of another kind than the run's are named by a TOML with [data], as in a study."
        raise type(error)(f"{error} {hint}") from error


def hidden_states(observer: Observer) -> Names:
    """Return the recorded states that are not measured at run time."""
    return tuple(name for i, name in enumerate(observer.recorded) if i not in observer.measured)


def check_channels(population: Population, observer: Observer, *, hidden: bool = True) -> None:
    """Refuse other channels, units of measure or sampling periods than those of the run, perhaps of hidden states."""
    needed = (*(observer.recorded if hidden else observer.outputs), *observer.inputs)
    there = (*population.states, *population.inputs)
    missing = [name for name in needed if name not in there]
    if missing or (hidden and needed != there):
        problem = f"{', '.join(missing)} is missing" if missing else "they are others, or in another order"
        both = f"the observer needs {', '.join(needed)}, the recordings have {', '.join(there)}"
        raise DataError(f"Channels: {problem}; {both}; record them, or correct the mapping.")
    units = observer.about.get("units_of_measure", {})
    for channel in population.channels:
        if channel.unit and units.get(channel.name, channel.unit) not in ("", channel.unit):
            both = f"{channel.name} is in {units[channel.name]!r} in the run and in {channel.unit!r} in the recordings"
            raise DataError(f"Channels: {both}; declare a scale step, or leave out a unit that is written differently.")
    if not np.isclose(population.sample_period_s, observer.sample_period_s, rtol=AGREED):
        both = f"the run has {observer.sample_period_s} s, the recordings {population.sample_period_s} s"
        raise DataError(f"Sampling period: {both}; declare a resample step.")


def load_observer(context: Context, name: str = "deployed") -> Observer:
    """Load an observer of a run by its name; that of a load has the channels of the one that is deployed."""
    store = context.store
    if not store.holds(*DEPLOYED):
        raise ConfigError(f"Run {store.folder}: has no deployed observer; run the study at least until synthesize.")
    known = {"deployed": DEPLOYED} | {n: ("observers", f"{n}.json") for n in context.observers_record["names"]}
    known |= {f"{k}/{LOAD}": (LOAD, f"{k}.json") for k in ("koopman", "linear") if store.holds(LOAD, f"{k}.json")}
    if name not in known:
        hint = did_you_mean(name, known)
        raise ConfigError(f"Run {store.folder}: has no observer {name!r}{hint} known are {', '.join(known)}.")
    chosen, about = Observer.load(store.path(*known[name])), context.deployed.about
    if chosen.about:
        return chosen
    return replace(chosen, about={key: about[key] for key in ("units_of_measure", "columns") if key in about})


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
            there = f"units are {some(sorted(units))}, parameters {', '.join(known) or 'none'}"
            raise ConfigError(f"--parameter {text}: should be UNIT.NAME=VALUE with a number; {there}.")
        given.setdefault(unit, {})[name] = value
    return given


@frozen
class FieldRecordings:
    """Recordings that need no hidden channels, with all that the observer needs to run on them."""

    observer: Observer
    population: Population
    values: Values
    sources: Texts = field(default_factory=dict)
    name: str | None = None  # of the parameter that a phase-locked loop follows

    @classmethod
    def open(
        cls, context: Context, data: Path, given: Collection[str] = (), track: str | None = None
    ) -> FieldRecordings:
        """Open what `data` names, and settle the parameters of every unit."""
        observer = load_observer(context)
        known = observer.lifting.parameters
        if track is not None and track not in known:
            raise ConfigError(f"--track {track}: the observer's parameters are {', '.join(known) or 'none'}.")
        population = with_gaps(open_data(context.config, data, hidden_states(observer)))
        check_channels(population, observer, hidden=False)
        chosen = parse_given(given, population.unit_ids, known)
        values, sources, reasons = unit_values(population, context.calibration, context.facts.identify_on, chosen)
        recordings = cls(observer, population, values, sources, track)
        recordings._settle(reasons)
        return recordings

    def _settle(self, reasons: Texts) -> None:
        """Refuse units without a parameter that the observer needs; one that is followed begins anywhere."""
        for unit, known in self.values.items():
            missing = [name for name in self.observer.lifting.parameters if name not in known]
            if set(missing) - {self.name}:
                reason, first = reasons.get(unit, "it was not calibrated."), missing[0]
                advice = f"Give it, --parameter {unit}.{first}=VALUE, or let it be followed, --track {first}."
                raise IdentificationError(f"Parameter {', '.join(missing)} of unit {unit}: {reason} {advice}")
            if self.name is not None:
                known[self.name] = self._start(unit, self.name) if missing else known[self.name]
                start = "of the smallest innovation" if missing else f"that is {self.sources.get(unit)}"
                self.sources[unit] = f"tracked from the value {start}"

    def _start(self, unit: str, name: str) -> float:
        """Return the phase at which the observer's innovation is smallest in the first episodes of a unit."""
        chosen, values = dict[EpisodeKey, Array](), self.values[unit]
        for key in self.population.keys(unit)[:_BATCH]:
            if sum(map(len, chosen.values())) < _BLOCK:
                chosen[key] = self.population.read(key)[:_BLOCK]
        arrived = arriving(self.observer, self.population, chosen, {unit: values})
        step, known = 2 * np.pi / _PHASES, {**self.observer.parameters, **values}
        signals = (self.observer, arrived.y, arrived.u, arrived.lengths, known, name)
        coarse = least_innovation(*signals, np.arange(_PHASES) * step)
        return float(np.mod(least_innovation(*signals, coarse + np.linspace(-1, 1, 9) * step), 2 * np.pi))

    def arriving(self, key: EpisodeKey) -> Arriving:
        """Read one episode as it arrives at the observer."""
        return arriving(self.observer, self.population, {key: self.population.read(key)}, self.values)

    def estimates(self) -> Iterator[Estimated]:
        """Run the observer over all episodes, block after block."""
        observer = self.observer
        for key in self.population.episodes:
            recorded = self.population.read(key)
            arrived = arriving(observer, self.population, {key: recorded}, self.values)
            loop = None if self.name is None else PhaseLockedLoop(observer, self.name, 1)
            course = Course(observer, 1, arrived.parameters, loop, watched=True)
            for block in pieces(len(recorded), _BLOCK):
                run = course.take(arrived.y[block], arrived.u[block])
                columns = run.estimates[:, 0, : len(observer.recorded)]
                if loop is not None:
                    columns = np.column_stack([columns, np.broadcast_to(run.followed, run.status.shape)[:, 0]])
                yield key, block.start, columns, run.status[:, 0], recorded[block]


def status_counts(status: Bits) -> Counter[str]:
    """Return how many samples have each bit."""
    return +Counter({str(bit.name): int(np.count_nonzero(status & bit)) for bit in SampleStatus})
