"""Recordings held in memory: a picklable source, and the same recordings prepared as a reader would.

The prepared form has the position offset calibrated away (mean of target minus measured over a window at rest) and the rest dropped.
Undoing the one-sample lag of the targets costs a reader the last sample, so the prepared form is without it.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from ..core.errors import DataError
from ..data.population import EpisodeKey

Array = npt.NDArray[Any]

REST_SAMPLES = 1000
OFFSET_WINDOW = slice(500, 1000)


@dataclass(frozen=True, eq=False)
class Recordings:
    """Source of raw episodes.

    Parameters
    ----------
    parts : mapping
        States, shape (n_states, n_samples), and inputs, shape (n_inputs, n_samples), of each episode.
        Episodes that follow the same reference share one array of inputs.
    """

    parts: Mapping[EpisodeKey, tuple[Array, Array]]

    def __call__(self, key: EpisodeKey) -> Array:
        """Return the samples of an episode, shape (n_samples, n_states + n_inputs)."""
        if key not in self.parts:
            first = next(iter(self.parts), None)
            raise DataError(
                f"Asked for {key}; the simulation has {len(self.parts)} episodes, first {first}; take keys from population.episodes."
            )
        return np.ascontiguousarray(np.concatenate(self.parts[key]).T)

    def restricted(self, keys: Iterable[EpisodeKey]) -> Recordings:
        """Return the same for fewer episodes, cheaper to send to another process."""
        return Recordings({key: self.parts[key] for key in keys})


@dataclass(frozen=True, eq=False)
class Prepared:
    """Source of episodes as the reader of raw recordings yields them.

    Parameters
    ----------
    raw : Recordings
    measured, target : int
        Columns of the measured position and its target, whose mean difference at rest is the offset.
    """

    raw: Recordings
    measured: int
    target: int

    def __call__(self, key: EpisodeKey) -> Array:
        """Return the samples of an episode after the rest and without the last one, position offset removed."""
        values = self.raw(key)
        rest = values[OFFSET_WINDOW]
        values[:, self.measured] += np.mean(rest[:, self.target] - rest[:, self.measured])
        return values[REST_SAMPLES:-1]

    def restricted(self, keys: Iterable[EpisodeKey]) -> Prepared:
        """Return the same for fewer episodes, cheaper to send to another process."""
        return Prepared(self.raw.restricted(keys), self.measured, self.target)
