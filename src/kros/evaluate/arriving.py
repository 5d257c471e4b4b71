"""Recordings as they arrive at an observer, with the lifting parameters of every unit."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from ..data import EpisodeBatch, Population
from ..data.population import EpisodeKey
from ..observer import Observer
from .sensor import as_arriving

Array = npt.NDArray[np.float64]


@dataclass(frozen=True)
class Arriving:
    """Episodes as they arrive: y (n_samples, batch, q), and u (n_samples, batch, m)."""

    batch: EpisodeBatch
    y: Array
    u: Array

    def parameters(self, observer: Observer) -> dict[str, npt.ArrayLike]:
        """Return the lifting parameters of all episodes."""
        return observer.own(self.batch.parameters)


def arriving(
    observer: Observer,
    population: Population,
    episodes: Mapping[EpisodeKey, Array],
    values: Mapping[str, Mapping[str, float]],
) -> Arriving:
    """Return episodes that were read, or parts of them, with lifting parameters by unit."""
    batch = EpisodeBatch.of(population, episodes, values)
    measured = [population.states.index(observer.lifting.states[i]) for i in observer.measured]
    y = as_arriving(batch, observer.sensor, population.states).measurements(measured)
    return Arriving(batch, y, batch.inputs[..., [population.inputs.index(name) for name in observer.inputs]])
