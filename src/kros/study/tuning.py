"""Training episodes as a judge: every tuned observer is chosen on the same ones, held-out episodes never take part."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from ..data.population import EpisodeKey, Population
from ..evaluate import EpisodeBatch, error_percent
from ..observer import Observer, run_observer

Array = npt.NDArray[np.float64]
TUNING_UNITS = 12
TUNING_EPISODES = 3
TUNING_S = 10.0


@dataclass(frozen=True, eq=False)
class TuningSet:
    """The first training episodes of some units, cut short, with each unit's lifting parameters."""

    population: Population
    keys: tuple[EpisodeKey, ...]
    parameters: dict[str, dict[str, float]]

    def read(self) -> Judge:
        """Read the episodes."""
        limit = round(TUNING_S / self.population.sample_period_s)
        batch = EpisodeBatch.read(self.population, self.keys, limit)
        return Judge(batch, batch.parameters(self.parameters))


@dataclass(frozen=True, eq=False)
class Judge:
    """Training episodes in memory."""

    batch: EpisodeBatch
    parameters: dict[str, Array]

    def percent(self, observer: Observer) -> Array:
        """Return the mean error of every state in percent of its range, shape (n,); infinite where the observer diverges."""
        values = self.parameters if observer.lifting.parameters else None
        estimate = run_observer(observer, self.batch.states[..., list(observer.measured)], self.batch.inputs, values)
        percent = error_percent(estimate, self.batch.states, self.batch.lengths).mean(axis=0)
        return np.where(np.isfinite(percent), percent, np.inf)

    def hidden_percent(self, observer: Observer) -> float:
        """Return the mean error over the states that are not measured (over all, where all are)."""
        return float(np.mean(self.percent(observer)[hidden_states(observer)]))


def hidden_states(observer: Observer) -> list[int]:
    """Return the indices of the states that are not measured; all, where all are."""
    return [i for i in range(observer.lifting.n_states) if i not in observer.measured] or list(observer.measured)
