"""Training data, and stretches of its episodes: drawn once, cut into shorter pieces for shorter horizons."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace

import numpy as np

from ...core import AnyArray, Array, DataError, Flags, Whole, frozen
from ...data import EpisodeKey, Population
from ...data.prepare import scale_population
from ...lifting import Lifting
from ..factors import Factor, Ranges

Keys = Mapping[str, Sequence[EpisodeKey]]


@frozen
class TrainingData:
    """Training episodes of every unit with their factors; the units that are `pooled` speak for the population."""

    population: Population
    keys: Keys
    lifting: Lifting
    parameters: Mapping[str, Array]  # (unit,)
    factor: Factor  # batch over units
    pooled: Flags  # (unit,)

    @property
    def rows(self) -> Whole:
        """Rows of the pooled units."""
        return np.flatnonzero(self.pooled)

    def divided_by(self, ranges: Ranges) -> TrainingData:
        """Return the data of channels divided by ranges."""
        sizes = ranges.sizes(self.lifting, self.population.inputs)
        factor = replace(self.factor, R=ranges.triangles(self.factor.R))
        population, lifting = scale_population(self.population, sizes), self.lifting.in_sizes(sizes)
        return replace(self, population=population, lifting=lifting, factor=factor)


@frozen
class Segments:
    """Stretches of recordings, the same number for every unit."""

    states: Array  # (n_samples, n, unit, segment)
    inputs: Array  # (n_samples, m, unit, segment)
    valid: Flags  # (n_samples, unit, segment)
    history: int = 0

    @property
    def n_units(self) -> int:
        """Number of units."""
        return self.valid.shape[1]

    @property
    def horizon(self) -> int:
        """Steps of a free run."""
        return len(self.valid) - 1 - self.history

    @property
    def compared(self) -> Flags:
        """Which samples a free run is compared with, shape (horizon, unit, segment)."""
        return self.valid[self.history + 1 :]

    def units(self, rows: AnyArray) -> Segments:
        """Return the segments of some units."""
        return self._each(lambda values: values[..., rows, :])

    def first(self, count: int) -> Segments:
        """Return the first segments of every unit."""
        return self._each(lambda values: values[..., :count])

    def cut(self, horizon: int) -> Segments:
        """Return pieces of `horizon` steps, as many as there are segments, spread evenly over them."""
        length = min(horizon, self.horizon) + 1
        pieces, n_segments = (len(self.valid) - self.history) // length, self.valid.shape[2]
        spread = np.unique(np.linspace(0, pieces * n_segments - 1, n_segments).round().astype(int))
        samples = np.arange(self.history + length)[:, None] + length * np.arange(pieces)  # (sample, piece)

        def fold(values: AnyArray) -> AnyArray:
            moved = np.moveaxis(values[samples], 1, -1)  # (sample, .., segment, piece)
            return moved.reshape(*moved.shape[:-2], -1)[..., spread]

        return self._each(fold)

    def _each(self, change: Callable[[AnyArray], AnyArray]) -> Segments:
        states, inputs, valid = (np.ascontiguousarray(change(a)) for a in (self.states, self.inputs, self.valid))
        return Segments(states, inputs, valid, self.history)


def read_segments(
    population: Population, keys: Keys, horizon: int, count: int, seed: int, history: int = 0
) -> Segments:
    """Draw segments of every unit, those of its last episode at the end."""
    n, length = len(population.states), history + horizon + 1
    values = np.empty((length, len(population.channels), len(keys), count))
    valid = np.empty((length, len(keys), count), dtype=bool)
    for row, (unit, episodes) in enumerate(keys.items()):
        if not episodes:
            raise DataError(f"Refinement: unit {unit} has no training episode; leave the unit out.")
        rng = np.random.default_rng(seed)  # as for any other unit: their order does not matter
        earlier, held = max(1, len(episodes) - 1), held_segments(count, keys)
        owners = np.array([*(i % earlier for i in range(count - held)), *[len(episodes) - 1] * held])
        for episode in dict.fromkeys(owners.tolist()):
            samples = population.read(episodes[episode])
            for column in np.flatnonzero(owners == episode):
                at = int(rng.integers(0, max(1, len(samples) - length + 1))) + np.arange(length)
                values[..., row, column] = samples[np.minimum(at, len(samples) - 1)]
                valid[:, row, column] = at < len(samples)
    return Segments(np.ascontiguousarray(values[:, :n]), np.ascontiguousarray(values[:, n:]), valid, history)


def held_segments(count: int, keys: Keys) -> int:
    """Return how many of the segments come from the last episode: its share, at least one where there are two."""
    typical = int(np.median([len(episodes) for episodes in keys.values()]))
    return min(count - 1, max(1, round(count / max(1, typical)))) if count > 1 else 0
