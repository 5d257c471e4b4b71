"""A population in other units of measure: every channel divided by a size, nothing copied."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

from .population import EpisodeKey, EpisodeSource, Population, part_columns, restrict

Array = npt.NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Scaled:
    """A source whose columns are divided by sizes, shape (n_columns,)."""

    source: EpisodeSource
    sizes: Array

    def __call__(self, key: EpisodeKey) -> Array:
        """Return the samples of an episode, shape (n_samples, n_columns)."""
        return np.asarray(self.source(key) / self.sizes)

    def restricted(self, keys: Iterable[EpisodeKey]) -> Scaled:
        """Return the same for fewer episodes."""
        return Scaled(restrict(self.source, keys), self.sizes)


def scale_population(population: Population, sizes: Mapping[str, float]) -> Population:
    """Return the population with channels divided by sizes; their units of measure are then unknown."""
    owners = [c.of or c.name for c in population.columns]
    factors = np.array([float(sizes.get(name, 1.0)) for name in owners])
    columns = [replace(c, unit="") if name in sizes else c for c, name in zip(population.columns, owners, strict=True)]
    return replace(population, source=Scaled(population.source, factors), **part_columns(columns))
