"""Training episodes that observers are tuned and chosen on: the same for all, and never those that are held out."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import field, replace
from functools import cached_property
from itertools import zip_longest

import numpy as np

from ..core import TINY, Array, frozen, grouped
from ..data import EpisodeBatch, EpisodeKey, Population
from ..data.prepare import scale_population
from ..evaluate.errors import error_rms, largest
from ..evaluate.sensor import as_shown
from ..identify import IdentifiedModels, ModelSet
from ..observer import Observer, Runtime, Seen, delay_of, spread
from ..observer.sensor import Sensors, in_units
from ..observer.simulate import run_observers


@frozen
class TrainingSettings:
    """How much of the recordings observers are compared on."""

    units: int = 12  # at most
    episodes: int = 3  # of every unit, more where they are short
    samples: int = 10_000  # of an episode, at most
    short: int = 2_000  # samples below which more episodes take part


TRAINING = TrainingSettings()


@frozen
class TrainingSet:
    """Training episodes of some units, as the sensor shows them, with each unit's lifting parameters."""

    population: Population
    keys: tuple[EpisodeKey, ...]
    parameters: dict[str, dict[str, float]]
    seen: Seen | None = None  # sizes in all training episodes
    sensor: Sensors = field(default_factory=dict)

    @classmethod
    def of(cls, identified: IdentifiedModels, models: ModelSet, sensor: Sensors | None = None) -> TrainingSet:
        """Take some of the first units, and of each some episodes from the first to the last."""
        whole, home = cls.whole(identified, models, sensor), identified.facts.identify_on
        parameters = dict(list(whole.parameters.items())[: TRAINING.units])
        episodes = [[k for k in whole.keys if (k.unit, k.condition) == (unit, home)] for unit in parameters]
        count = TRAINING.episodes * max(1, round(TRAINING.short / len(whole.population.read(episodes[0][0]))))
        keys = tuple(k for of_unit in episodes for k in spread(of_unit, count))
        return replace(whole, keys=keys, parameters=parameters, population=whole.population.select(list(parameters)))

    @classmethod
    def whole(cls, identified: IdentifiedModels, models: ModelSet, sensor: Sensors | None = None) -> TrainingSet:
        """Take all training episodes of pooled units, one of every unit and condition before the second of any."""
        facts = identified.facts
        parameters = {u: identified.parameters[u] for u in facts.pooled if u in models.unit_ids}
        trained = (key for unit in parameters for key in facts.keys("train", unit))
        groups = grouped(trained, lambda key: (key.unit, key.condition))
        keys = tuple(k for turn in zip_longest(*groups.values()) for k in turn if k is not None)
        population, seen = identified.population.select(list(parameters)), seen_by(identified, models.measured)
        return cls(population, keys, parameters, seen, sensor or {})

    def normalised(self, models: ModelSet) -> TrainingSet:
        """Return the same in channels divided by the ranges of models."""
        outputs, inputs = models.output_scale[list(models.measured)], models.input_scale[: len(models.recorded_inputs)]
        seen = None if self.seen is None else Seen(self.seen.measured / outputs, self.seen.inputs / inputs)
        population, sensor = scale_population(self.population, models.sizes), in_units(self.sensor, models.sizes)
        return replace(self, population=population, seen=seen, sensor=sensor)

    @property
    def runtime(self) -> Runtime:
        """What observers have to know of the machine: the delay of measurements, and where states start."""
        return Runtime(delay_of(self.sensor), start=self.start)

    @cached_property
    def start(self) -> Array | None:
        """The mean first state of the episodes; None where all of it is zero.

        It counts by ``1 - error^2 / mean^2``, if that is positive (James and Stein): little where signs are random.
        """
        values = EpisodeBatch.read(self.population, self.keys, 1).states[0]
        mean, squared_error = values.mean(axis=0), values.var(axis=0) / len(values)
        first = mean * np.maximum(1 - squared_error / np.maximum(mean**2, TINY), 0.0)
        return first if first.any() else None

    def read(self, most: int | None = TRAINING.samples) -> EpisodeBatch:
        """Read the episodes, cut short, or whole with None."""
        return self._shown(self.keys, most)

    def read_one(self, key: EpisodeKey) -> EpisodeBatch:
        """Read an episode, whole, without the bias: its size is declared, and its sign cannot be learned."""
        sensor = {name: one.model_copy(update={"bias": 0}) for name, one in self.sensor.items()}
        return replace(self, sensor=sensor)._shown([key])

    def one_by_one(self) -> Iterator[EpisodeBatch]:
        """Read every episode by itself, as `read_one` does."""
        return map(self.read_one, self.keys)

    def _shown(self, keys: Sequence[EpisodeKey], limit: int | None = None) -> EpisodeBatch:
        """Read episodes as the sensor shows them."""
        batch = EpisodeBatch.read(self.population, keys, limit, self.parameters)
        return as_shown(batch, self.sensor, self.population.states)


def percent_of(observers: Sequence[Observer], batch: EpisodeBatch) -> Array:
    """Return typical errors of observers of one model in percent of a unit's largest value, (observer, n), or infinity.

    A unit's largest value is that of all its episodes in a condition: an episode without motion has no size. The mean
    over units is geometric, so that a defective one does not decide.
    """
    x, lengths, y = batch.states, batch.lengths, batch.measurements(observers[0].measured)
    size, groups = largest(x, lengths), np.array([f"{key.unit}\n{key.condition}" for key in batch.keys])
    size = np.array([size[groups == group].max(axis=0) for group in groups])
    runs = run_observers(observers, y, batch.inputs, observers[0].own(batch.parameters))
    with np.errstate(divide="ignore", invalid="ignore"):
        rms = (error_rms(e[..., : x.shape[-1]], x, lengths) for e in runs)
        percents = np.array([100 * error / size for error in rms])
    units = np.array([key.unit for key in batch.keys])
    by_unit = np.stack([percents[:, units == unit].mean(axis=1) for unit in dict.fromkeys(units)])
    errors = np.exp(np.log(np.maximum(by_unit, TINY)).mean(axis=0))
    return np.where(np.isfinite(errors), errors, np.inf)


def seen_by(identified: IdentifiedModels, measured: Sequence[int]) -> Seen:
    """Return the sizes of the measured states and of the inputs; far larger samples are implausible."""
    states, inputs, sizes = identified.population.states, identified.population.inputs, identified.sizes
    return Seen(np.array([sizes[states[i]] for i in measured]), np.array([sizes[name] for name in inputs]))


def hidden_mean(values: Array, measured: Sequence[int]) -> Array:
    """Return the geometric mean of values (..., n) over the hidden states (all, where none is hidden)."""
    hidden = [i for i in range(values.shape[-1]) if i not in measured] or list(measured)
    return np.exp(np.mean(np.log(np.maximum(values[..., hidden], TINY)), axis=-1))


def rank(percent: Array, limit: Array, measured: Sequence[int]) -> tuple[bool, float]:
    """Order candidates: those that exceed the open loop in no state first, by the error of hidden states over its."""
    ratio = percent / np.maximum(limit, TINY)
    worst = float(ratio.max())
    return (False, float(hidden_mean(ratio, measured))) if worst <= 1 else (True, worst)
