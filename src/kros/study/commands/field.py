"""The deployed observer on recordings from the field: what arrives, parameters of every unit, estimates."""

from __future__ import annotations

from collections.abc import Collection, Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import numpy.typing as npt

from ...core.errors import ConfigError, IdentificationError
from ...data import Population
from ...data.population import EpisodeKey
from ...data.prepare import with_gaps
from ...evaluate.arriving import Arriving, arriving
from ...observer import Observer, run_with_status, track_parameter
from ...observer.screen import Bits, SampleStatus, sample_status
from ...observer.tracking import PhaseLockedLoop, least_innovation
from ..config import StudyConfig
from ..engine.store import Store
from .recordings import (
    UnitValues,
    check_channels,
    hidden_states,
    identify_on,
    load_calibration,
    open_data,
    parse_given,
    unit_values,
)

Array = npt.NDArray[np.float64]
_BATCH, _PHASES, _SEEN = 64, 24, 20_000  # episodes, phases, samples


@dataclass(frozen=True)
class FieldRecordings:
    """Recordings that need no hidden channels, with all that the observer needs to run on them."""

    observer: Observer
    population: Population
    values: dict[str, dict[str, float]]
    sources: dict[str, str]
    followed: frozenset[str]
    name: str | None

    @classmethod
    def open(
        cls, config: StudyConfig, store: Store, data: Path, given: Collection[str] = (), track: str | None = None
    ) -> FieldRecordings:
        """Open what `data` names, and settle the parameters of every unit."""
        if not store.holds("observers", "deployed.json"):
            raise ConfigError(f"Run {store.folder}: has no deployed observer; run the study at least until synthesize.")
        observer = Observer.load(store.path("observers", "deployed.json"))
        known = observer.lifting.parameters
        if track is not None and track not in known:
            raise ConfigError(f"--track {track}: the observer's parameters are {', '.join(known) or 'none'}.")
        population = with_gaps(open_data(config, data, hidden_states(observer)))
        check_channels(population, observer, field_recordings=True)
        calibration = load_calibration(store)
        units = unit_values(population, calibration, identify_on(store), parse_given(given, population.unit_ids, known))
        phase = None if calibration is None else calibration.spec.parameter
        return cls(observer, population, *_settled(units, observer, population, track, phase))

    def batches(self, keys: tuple[EpisodeKey, ...] | None = None) -> Iterator[Arriving]:
        """Read episodes, some at a time."""
        keys = keys or self.population.episodes
        values = {u: {**self.observer.parameters, **known} for u, known in self.values.items()}
        for start in range(0, len(keys), _BATCH):
            yield arriving(self.observer, self.population, keys[start : start + _BATCH], values)

    def estimates(self, found: Arriving) -> tuple[Array, Array | None, Bits]:
        """Run the observer; return estimates, the parameter that is followed, and the bits of every sample's status."""
        observer, units, n = self.observer, found.batch.units, len(self.observer.recorded)
        estimates, status = np.empty((*found.y.shape[:2], n)), sample_status(observer, found.y, found.u)
        others, rows = (
            [i for i, unit in enumerate(units) if (unit in self.followed) is wanted] for wanted in (False, True)
        )
        if others:
            parameters = found.parameters(observer, others)
            x, status[:, others] = run_with_status(observer, found.y[:, others], found.u[:, others], parameters)
            estimates[:, others] = x[..., :n]
        if self.name is None:
            return estimates, None, status
        followed = np.tile(found.batch.parameters[self.name], (len(found.y), 1))
        if rows:
            tracked = track_parameter(
                observer, found.y[:, rows], found.u[:, rows], found.parameters(observer, rows), self.name
            )
            estimates[:, rows], followed[:, rows] = tracked.estimates[..., :n], tracked.values
            status[:, rows] |= np.where(tracked.restarted, np.uint8(SampleStatus.RESTARTED), np.uint8(0))
        return estimates, followed, status

    def count_status(self, found: Arriving, counts: dict[str, dict[str, int]], status: Bits | None = None) -> None:
        """Add to the samples of every unit that are missing, invalid, beyond limits, or restart the observer."""
        status = sample_status(self.observer, found.y, found.u) if status is None else status
        for i, (unit, length) in enumerate(zip(found.batch.units, found.batch.lengths, strict=True)):
            of_unit = counts.setdefault(unit, {})
            for bit in SampleStatus:
                if number := int(np.count_nonzero(status[:length, i] & bit)):
                    of_unit[str(bit.name)] = of_unit.get(str(bit.name), 0) + number


def _settled(
    units: UnitValues, observer: Observer, population: Population, track: str | None, phase: str | None
) -> tuple[dict[str, dict[str, float]], dict[str, str], frozenset[str], str | None]:
    """Return the values, sources and the units whose parameter is followed, with its name; refuse what is not known."""
    sources, followed = dict(units.sources), set()
    values = {unit: dict(own) for unit, own in units.values.items()}
    unknown = {unit: [p for p in observer.lifting.parameters if p not in own] for unit, own in values.items()}
    name = track or next((p for missing in unknown.values() for p in missing), "")
    for unit, missing in unknown.items():
        if track is None and not missing:
            continue
        if set(missing) - {name} or not _trackable(observer, name):
            reason = units.reasons.get(unit, "it was not calibrated.")
            loop = "a phase-locked loop either, which needs one unknown parameter and an observer without delays"
            follow = f"It cannot be followed by {loop}; give it, --parameter {unit}.{name}=VALUE."
            raise IdentificationError(f"Parameter {', '.join(missing) or name} of unit {unit}: {reason} {follow}")
        source = f"value that is {sources.get(unit)}"
        if name in missing and name == phase:
            values[unit][name] = _start(observer, population, unit, values[unit], name)
            source = "value of the smallest innovation"
        elif name in missing:
            source = "value of the nominal unit"
        sources[unit] = f"tracked from the {source}"
        followed.add(unit)
    return values, sources, frozenset(followed), name if followed else None


def _trackable(observer: Observer, name: str) -> bool:
    try:
        PhaseLockedLoop(observer, name, 1)
    except ConfigError:
        return False
    return True


def _start(observer: Observer, population: Population, unit: str, own: dict[str, float], name: str) -> float:
    """Return the phase at which the observer's innovation is smallest in the first episodes of a unit."""
    seen = 0
    chosen: list[EpisodeKey] = []
    for key in population.keys(unit)[:_BATCH]:
        if seen < _SEEN:
            chosen, seen = [*chosen, key], seen + len(population.read(key))
    found, step = arriving(observer, population, tuple(chosen), {unit: own}, _SEEN), 2 * np.pi / _PHASES
    asked = (observer, found.y, found.u, found.batch.lengths, {**observer.parameters, **own}, name)
    coarse = least_innovation(*asked, np.arange(_PHASES) * step)
    return float(np.mod(least_innovation(*asked, coarse + np.linspace(-1, 1, 9) * step), 2 * np.pi))
