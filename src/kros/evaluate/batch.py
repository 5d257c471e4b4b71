"""Test episodes side by side: one array for all, shorter episodes held at their last sample."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from ..core.errors import DataError
from ..data.population import EpisodeKey, Population
from ..lifting import Lifting

Array = npt.NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class EpisodeBatch:
    """Episodes of one population, time first.

    Parameters
    ----------
    keys : tuple of EpisodeKey
    lengths : ndarray, shape (batch,)
    states : ndarray, shape (n_samples, batch, n)
    inputs : ndarray, shape (n_samples, batch, m)
    """

    keys: tuple[EpisodeKey, ...]
    lengths: npt.NDArray[np.int64]
    states: Array
    inputs: Array

    @classmethod
    def read(cls, population: Population, keys: Sequence[EpisodeKey], max_samples: int | None = None) -> EpisodeBatch:
        """Read episodes, each cut to at most `max_samples`."""
        if not keys:
            raise DataError("Reading a batch of episodes: no episodes were named; check the split.")
        episodes = [population.read(key)[:max_samples] for key in keys]
        lengths = np.array([len(e) for e in episodes])
        n = len(population.states)
        values = np.empty((lengths.max(), len(keys), len(population.channels)))
        for i, episode in enumerate(episodes):
            values[: len(episode), i] = episode
            values[len(episode) :, i] = episode[-1]
        return cls(tuple(keys), lengths, values[..., :n], np.ascontiguousarray(values[..., n:]))

    def first_states(self, lifting: Lifting) -> Array:
        """Return what a free run starts from: the first states of every episode, and those that the lifting's delays need.

        Returns
        -------
        ndarray, shape (batch, n), or (batch, history + 1, n) for a lifting with delays

        Raises
        ------
        DataError
            When an episode is shorter than the history.
        """
        h = lifting.history
        if not h:
            return self.states[0]
        for key, length in zip(self.keys, self.lengths, strict=True):
            if length < h + 1:
                raise DataError(
                    f"Free run over {key}: needs {h + 1} samples for delays of up to {h}, found {length}; leave the episode out."
                )
        return np.swapaxes(self.states[: h + 1], 0, 1)

    def parameters(self, units: Mapping[str, Mapping[str, float]]) -> dict[str, Array]:
        """Return lifting parameters for every episode from those of its unit."""
        rows = [units[k.unit] for k in self.keys]
        return {name: np.array([row[name] for row in rows]) for name in (rows[0] if rows else {})}
