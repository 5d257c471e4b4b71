"""Triangular factors of every episode by itself, for leaving episodes out and for drawing them again.

population --each episode read once--> factors (unit, episode), for as many liftings as are asked for
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
import numpy.typing as npt

from ..core.errors import DataError
from ..data.population import EpisodeKey, Population
from ..lifting import Lifting
from .factors import Factor, lifted_factor, reduce_episode

Keys = Mapping[str, Sequence[EpisodeKey]]


def reduce_episodes(population: Population, keys: Keys, liftings: Mapping[str, Lifting]) -> dict[str, Factor]:
    """Read every episode once and reduce it for every lifting.

    Parameters
    ----------
    population : Population
    keys : mapping of str to sequence of EpisodeKey
        Episodes of every unit.
    liftings : mapping of str to Lifting

    Returns
    -------
    dict of str to Factor
        Parameter-free, batch (unit, episode) in the order of `keys`; zero where a unit has fewer episodes than others.

    Raises
    ------
    DataError
        When there are no episodes at all.
    """
    most = max((len(episodes) for episodes in keys.values()), default=0)
    if most == 0:
        raise DataError(
            f"Factors by episode: {len(keys)} units without an episode among them; pass keys as population.keys(unit) gives them."
        )
    found: dict[str, Factor] = {}
    for row, episodes in enumerate(keys.values()):
        for column, key in enumerate(episodes):
            x, u = population.read_parts(key)
            for name, lifting in liftings.items():
                one = reduce_episode(x, u, lifting)
                if name not in found:
                    batch = (len(keys), most)
                    found[name] = Factor(np.zeros(batch + one.R.shape), np.zeros(batch + one.peak.shape), np.zeros(batch, dtype=np.int64))
                whole = found[name]
                whole.R[row, column], whole.peak[row, column], whole.n_samples[row, column] = one.R, one.peak, one.n_samples
    return found


def episode_factors(population: Population, keys: Keys, lifting: Lifting, parameters: Mapping[str, npt.ArrayLike] | None = None) -> Factor:
    """Return factors of [Psi | Theta_plus] of every episode, batch (unit, episode).

    Parameters
    ----------
    population : Population
    keys : mapping of str to sequence of EpisodeKey
    lifting : Lifting
    parameters : mapping of str to array_like, shape (unit,), optional
        The lifting's parameters, in the order of `keys`.

    Returns
    -------
    Factor
        Zero where a unit has fewer episodes than others.
    """
    own = {name: np.asarray((parameters or {})[name], dtype=float)[:, None] for name in lifting.parameters}
    return lifted_factor(reduce_episodes(population, keys, {"": lifting})[""], lifting, own, lifting)
