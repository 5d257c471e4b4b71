"""Training episodes as a judge: every tuned observer is chosen on the same ones, held-out episodes never take part."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from ..data import EpisodeBatch
from ..data.population import EpisodeKey, Population
from ..evaluate import error_percent
from ..observer import Observer, Seen, run_observer, run_observers

Array = npt.NDArray[np.float64]
TUNING_UNITS = 12
TUNING_EPISODES = 3
TUNING_S = 10.0
SIDE_BY_SIDE = 20  # keeps a study of twelve units below 200 MB


@dataclass(frozen=True, eq=False)
class TuningSet:
    """The first training episodes of some units, cut short, with each unit's lifting parameters; `seen` are the sizes in all training episodes."""

    population: Population
    keys: tuple[EpisodeKey, ...]
    parameters: dict[str, dict[str, float]]
    seen: Seen | None = None

    def read(self) -> Judge:
        """Read the episodes."""
        limit = round(TUNING_S / self.population.sample_period_s)
        batch = EpisodeBatch.read(self.population, self.keys, limit, self.parameters)
        return Judge(batch)


@dataclass(frozen=True, eq=False)
class Judge:
    """Training episodes in memory."""

    batch: EpisodeBatch

    @property
    def parameters(self) -> dict[str, Array]:
        """Lifting parameters, shape (batch,) each."""
        return self.batch.parameters

    def first(self, n_samples: float) -> Judge:
        """Return the same episodes, cut to so many samples."""
        return Judge(self.batch.head(round(n_samples)))

    def part(self, rows: Sequence[int]) -> Judge:
        """Return some of the episodes."""
        return Judge(self.batch.take(rows))

    def measurements(self, measured: Sequence[int]) -> Array:
        """Return the measured states, shape (n_samples, batch, q)."""
        return np.ascontiguousarray(self.batch.states[..., list(measured)])

    def percent(self, observer: Observer) -> Array:
        """Return the mean error of every recorded state in percent of the largest value, shape (n,); infinite where the observer diverges."""
        values = self.parameters if observer.lifting.parameters else None
        estimate = run_observer(observer, self.batch.states[..., list(observer.measured)], self.batch.inputs, values)
        return self.compare([estimate])[0]

    def percent_of_all(self, observers: Sequence[Observer]) -> Array:
        """Return the same for observers of one model that differ in their corrections, shape (observer, n): several at a time run side by side."""
        values = self.parameters if observers[0].lifting.parameters else None
        y = self.batch.states[..., list(observers[0].measured)]
        found = []
        for start in range(0, len(observers), SIDE_BY_SIDE):
            found += [*self.compare(run_observers(observers[start : start + SIDE_BY_SIDE], y, self.batch.inputs, values))]
        return np.array(found)

    def compare(self, estimates: Iterable[Array]) -> Array:
        """Return the same for estimates that are there already, shape (observer, n); those of a memory have nothing to be compared with."""
        n = self.batch.states.shape[-1]
        found = [error_percent(estimate[..., :n], self.batch.states, self.batch.lengths).mean(axis=0) for estimate in estimates]
        return np.where(np.isfinite(found), found, np.inf)


def hidden_mean(values: Array, measured: Sequence[int]) -> Array:
    """Return the geometric mean over the states that are not measured (all, where none is hidden); `values` has shape (..., n)."""
    hidden = [i for i in range(values.shape[-1]) if i not in measured] or list(measured)
    return np.asarray(np.exp(np.mean(np.log(np.maximum(values[..., hidden], np.finfo(float).tiny)), axis=-1)))


def rank(percent: Array, limit: Array, measured: Sequence[int]) -> tuple[bool, float]:
    """Order candidates: first those that are in no state worse than the open loop, by the error of the hidden states relative to it.

    Parameters
    ----------
    percent, limit : ndarray, shape (n,)
        Errors of the candidate and of the open loop, percent of the largest value.
    measured : sequence of int

    Returns
    -------
    bool
        Whether the candidate is worse than the open loop in some state.
    float
        Geometric mean of the hidden states' errors over those of the open loop; of the worst state where the candidate is worse.
    """
    ratio = percent / np.maximum(limit, np.finfo(float).tiny)
    worst = float(ratio.max())
    if not worst <= 1:
        return True, worst
    return False, float(hidden_mean(ratio, measured))
