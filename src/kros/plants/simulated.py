"""What every simulation returns: recordings, and what is true about them."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import Any, Generic, Protocol, TypeVar

import numpy as np
import numpy.typing as npt

from ..core.errors import DataError
from ..data.population import EpisodeKey, Population

Array = npt.NDArray[Any]


class HasTruth(Protocol):
    """True parameters of a simulated population."""

    def as_dict(self) -> dict[str, Any]:
        """Return everything but long signals, ready for JSON."""


T = TypeVar("T", bound=HasTruth)


@dataclass(frozen=True, eq=False)
class SimulatedPopulation(Generic[T]):
    """Recordings and what is true about them.

    Parameters
    ----------
    population : Population
        Ready for identification, as a reader yields it.
    raw : Population
        As recorded, before preparation; the same as `population` where a plant needs none.
    truth : object with ``as_dict()``

    Examples
    --------
    >>> from kros.plants import DcMotorPopulation
    >>> simulated = DcMotorPopulation(n_units=2, n_episodes=1, seconds=1.0, seed=3).simulate()
    >>> list(simulated.truth.as_dict()["units"])
    ['001', '002']
    """

    population: Population
    raw: Population
    truth: T


@dataclass(frozen=True, eq=False)
class SimulatedEpisodes:
    """Source of raw episodes in memory, which can be pickled."""

    parts: Mapping[EpisodeKey, tuple[Array, ...]]

    def __call__(self, key: EpisodeKey) -> Array:
        """Return the samples of an episode, shape (n_samples, n_states + n_inputs + n_truths)."""
        if key not in self.parts:
            first = next(iter(self.parts), None)
            raise DataError(
                f"Asked for {key}; the simulation has {len(self.parts)} episodes, first {first}; take keys from population.episodes."
            )
        return np.ascontiguousarray(np.concatenate(self.parts[key]).T)

    def restricted(self, keys: Iterable[EpisodeKey]) -> SimulatedEpisodes:
        """Return the same for fewer episodes, cheaper to send to another process."""
        return SimulatedEpisodes({key: self.parts[key] for key in keys})
