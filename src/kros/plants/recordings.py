"""Recordings held in memory: a source that can be pickled."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from ..core.errors import DataError
from ..data.population import EpisodeKey

Array = npt.NDArray[Any]


@dataclass(frozen=True, eq=False)
class Recordings:
    """Source of raw episodes."""

    parts: Mapping[EpisodeKey, tuple[Array, ...]]

    def __call__(self, key: EpisodeKey) -> Array:
        """Return the samples of an episode, shape (n_samples, n_states + n_inputs + n_truths)."""
        if key not in self.parts:
            first = next(iter(self.parts), None)
            raise DataError(
                f"Asked for {key}; the simulation has {len(self.parts)} episodes, first {first}; take keys from population.episodes."
            )
        return np.ascontiguousarray(np.concatenate(self.parts[key]).T)

    def restricted(self, keys: Iterable[EpisodeKey]) -> Recordings:
        """Return the same for fewer episodes, cheaper to send to another process."""
        return Recordings({key: self.parts[key] for key in keys})
