"""What every simulation returns: recordings, and what is true about them."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Generic, Protocol, TypeVar

from ..data.population import Population


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
