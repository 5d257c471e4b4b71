"""Training episodes that observers are tuned and chosen on: the same ones for all, and never those that are held out."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from itertools import zip_longest
from typing import TypeVar

import numpy as np
import numpy.typing as npt

from ..data import EpisodeBatch
from ..data.population import EpisodeKey, Population
from ..data.prepare import scale_population
from ..evaluate import error_rms
from ..evaluate.sensor import as_shown
from ..identify import ModelSet
from ..identify.identified import IdentifiedModels
from ..observer import Observer, Seen, Sensor, run_observer, run_observers
from ..observer.sensor import Sensors, in_units

Array = npt.NDArray[np.float64]
T = TypeVar("T")
TUNING_UNITS = 12
TUNING_EPISODES = 3
TUNING_SAMPLES, SHORT_SAMPLES = 10_000, 2_000  # of an episode, at most, and below which more episodes take part
SIDE_BY_SIDE = 20  # keeps a study of twelve units below 200 MB


@dataclass(frozen=True, eq=False)
class TrainingSet:
    """Training episodes of some units, as the sensor shows them, with each unit's lifting parameters; `seen` are the sizes in all training episodes."""

    population: Population
    keys: tuple[EpisodeKey, ...]
    parameters: dict[str, dict[str, float]]
    seen: Seen | None = None
    sensor: Sensors = field(default_factory=dict)

    @classmethod
    def of(cls, identified: IdentifiedModels, models: ModelSet, sensor: Sensors | None = None) -> TrainingSet:
        """Take some of the first units, and of each some episodes from the first to the last."""
        facts, known = identified.facts, identified.parameters
        units = [u for u in facts.pooled if u in models.unit_ids][:TUNING_UNITS]
        every = [facts.keys("train", u, facts.identify_on) for u in units]
        length = len(identified.population.read(every[0][0])) if every and every[0] else SHORT_SAMPLES
        count = TUNING_EPISODES * max(1, round(SHORT_SAMPLES / length))
        keys = tuple(k for own in every for k in spread(own, count))
        return cls(
            identified.population.select(units),
            keys,
            {u: known[u] for u in units},
            seen_by(identified, models.measured),
            sensor or {},
        )

    @classmethod
    def whole(cls, identified: IdentifiedModels, models: ModelSet, sensor: Sensors | None = None) -> TrainingSet:
        """Take all training episodes of all pooled units in all conditions, one of every unit and condition before the second of any."""
        facts, known = identified.facts, identified.parameters
        units = [u for u in facts.pooled if u in models.unit_ids]
        groups = [
            facts.keys("train", u, c) for u in units for c in dict.fromkeys(k.condition for k in facts.keys("train", u))
        ]
        keys = tuple(k for turn in zip_longest(*groups) for k in turn if k is not None)
        return cls(
            identified.population.select(units),
            keys,
            {u: known[u] for u in units},
            seen_by(identified, models.measured),
            sensor or {},
        )

    def normalised(self, models: ModelSet) -> TrainingSet:
        """Return the same in channels divided by the ranges of models."""
        outputs, inputs = models.output_scale[list(models.measured)], models.input_scale[: len(models.recorded_inputs)]
        seen = None if self.seen is None else self.seen.times(1 / outputs, 1 / inputs)
        return replace(
            self,
            population=scale_population(self.population, models.sizes),
            seen=seen,
            sensor=in_units(self.sensor, models.sizes),
        )

    def first_of_units(self) -> TrainingSet:
        """Return the first episode of every unit."""
        firsts = {key.unit: key for key in reversed(self.keys)}
        return replace(self, keys=tuple(key for key in self.keys if firsts[key.unit] == key))

    def read(self) -> ValidationSet:
        """Read the episodes, cut short."""
        return self._shown(self.keys, TUNING_SAMPLES)

    def read_whole(self) -> ValidationSet:
        """Read the episodes."""
        return self._shown(self.keys)

    def read_one(self, key: EpisodeKey) -> EpisodeBatch:
        """Read an episode, whole, without the bias."""
        return replace(self, sensor=_without(self.sensor, "bias"))._shown([key]).batch

    def one_by_one(self) -> Iterator[ValidationSet]:
        """Read every episode by itself, whole, without the bias: its size is declared, and its sign nobody can learn."""
        unbiased = replace(self, sensor=_without(self.sensor, "bias"))
        return (unbiased._shown([key]) for key in self.keys)

    def _shown(self, keys: Sequence[EpisodeKey], limit: int | None = None) -> ValidationSet:
        batch, states = EpisodeBatch.read(self.population, keys, limit, self.parameters), self.population.states
        return ValidationSet(as_shown(batch, self.sensor, states), self.sensor, states)


@dataclass(frozen=True, eq=False)
class ValidationSet:
    """Training episodes in memory, as the sensor that was declared shows them."""

    batch: EpisodeBatch
    sensor: Sensors = field(default_factory=dict)
    states: tuple[str, ...] = ()

    @property
    def on_time(self) -> ValidationSet:
        """The same with measurements that are neither late, which observers know of, nor biased, which none can learn: what they are fitted to."""
        sensor = _without(self.sensor, "delay_samples", "bias")
        return replace(
            self, batch=as_shown(replace(self.batch, shown=None, lost=None), sensor, self.states), sensor=sensor
        )

    @property
    def parameters(self) -> dict[str, Array]:
        """Lifting parameters, shape (batch,) each."""
        return self.batch.parameters

    def first(self, n_samples: int) -> ValidationSet:
        """Return the same episodes, cut to so many samples."""
        return replace(self, batch=self.batch.head(n_samples))

    def part(self, rows: Sequence[int]) -> ValidationSet:
        """Return some of the episodes."""
        return replace(self, batch=self.batch.take(rows))

    def measurements(self, measured: Sequence[int]) -> Array:
        """Return what the sensor shows of the measured states, shape (n_samples, batch, q); NaN where a sample does not arrive."""
        return self.batch.measurements(measured)

    def steps(self, measured: Sequence[int]) -> Array:
        """Return the RMS change of measured states from sample to sample, shape (q,)."""
        return np.asarray(np.sqrt(np.mean(np.diff(self.batch.states[..., list(measured)], axis=0) ** 2, axis=(0, 1))))

    def percent(self, observer: Observer) -> Array:
        """Return the mean error of every recorded state in percent of the largest value, shape (n,); infinite where the observer diverges."""
        values = self.parameters if observer.lifting.parameters else None
        estimate = run_observer(observer, self.measurements(observer.measured), self.batch.inputs, values)
        return self.compare([estimate])[0]

    def percent_of_all(self, observers: Sequence[Observer]) -> Array:
        """Return the same for observers of one model that differ in their corrections, shape (observer, n): several at a time run side by side."""
        values = self.parameters if observers[0].lifting.parameters else None
        y = self.measurements(observers[0].measured)
        found = []
        for start in range(0, len(observers), SIDE_BY_SIDE):
            found += [
                *self.compare(run_observers(observers[start : start + SIDE_BY_SIDE], y, self.batch.inputs, values))
            ]
        return np.array(found)

    def compare(self, estimates: Iterable[Array]) -> Array:
        """Return the same for estimates that are there already, shape (observer, n); those of a memory have nothing to be compared with."""
        x, lengths = self.batch.states, self.batch.lengths
        inside = np.arange(len(x))[:, None, None] < lengths[:, None]
        size = np.max(np.abs(x), axis=0, where=inside, initial=0.0)
        groups = [
            (key.unit, key.condition) for key in self.batch.keys
        ]  # an episode in which a machine hardly moves has no size of its own
        of = {group: size[[i for i, own in enumerate(groups) if own == group]].max(axis=0) for group in set(groups)}
        size = np.array([of[group] for group in groups])
        x = np.ascontiguousarray(x.swapaxes(1, 2)).swapaxes(1, 2)  # in memory as estimates are
        with np.errstate(divide="ignore", invalid="ignore"):
            found = [(100 * error_rms(e[..., : x.shape[-1]], x, lengths) / size).mean(axis=0) for e in estimates]
        return np.where(np.isfinite(found), found, np.inf)


def _without(sensor: Sensors, *what: str) -> dict[str, Sensor]:
    return {name: own.model_copy(update=dict.fromkeys(what, 0)) for name, own in sensor.items()}


def seen_by(identified: IdentifiedModels, measured: Sequence[int]) -> Seen:
    """Return the sizes of the measured states and of the inputs, beyond which an observer believes less."""
    states, inputs, sizes = identified.population.states, identified.population.inputs, identified.sizes
    return Seen(np.array([sizes[states[i]] for i in measured]), np.array([sizes[name] for name in inputs]))


def spread(keys: Sequence[T], count: int) -> list[T]:
    """Return so many from the first to the last."""
    if len(keys) <= count:
        return list(keys)
    return [keys[i] for i in np.linspace(0, len(keys) - 1, count).round().astype(int)]


def hidden_mean(values: Array, measured: Sequence[int]) -> Array:
    """Return the geometric mean over the states that are not measured (all, where none is hidden); `values` has shape (..., n)."""
    hidden = [i for i in range(values.shape[-1]) if i not in measured] or list(measured)
    return np.asarray(np.exp(np.mean(np.log(np.maximum(values[..., hidden], np.finfo(float).tiny)), axis=-1)))


def rank(percent: Array, limit: Array, measured: Sequence[int]) -> tuple[bool, float]:
    """Order candidates: first those that are in no state worse than the open loop, by the error of the hidden states relative to it."""
    ratio = percent / np.maximum(limit, np.finfo(float).tiny)
    worst = float(ratio.max())
    if not worst <= 1:
        return True, worst
    return False, float(hidden_mean(ratio, measured))
