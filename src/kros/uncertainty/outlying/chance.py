r"""What the noise of a unit's own estimate makes of a good unit: the bound of a unit that was recorded less than the others.

Scores of units compare estimates that are equally good. A unit that was recorded less scatters more, and exceeds the others for that alone. Its
bound comes from the others, estimated as badly as it was:

    G_i + s_i dG,       s_i^2 = max(0, 1 - var_i / var)        entry by entry, frequency by frequency

with dG a draw of the unit's own estimation error, var its variance and var_i that of unit i, which has some of it already. Each such estimate is
scored against the cover of the others as they are. Location and scale are measured on these scores, averaged over draws, and the bound is that
of the tail model at the same rate (`tail`). With equal variances nothing is added and the bound is the usual one.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from ..forms import Form
from .distances import Distances, distances, median_levels
from .groups import covers, excess
from .tail import LEAST_SCORES, gumbel, prediction_bound, prediction_factor

Array = npt.NDArray[Any]

AS_GOOD = 1.25  # ratio of variances up to which estimates count as equally good: 1 dB
_MOST_UNITS = 24  # that are estimated badly, and that are nominals for them
_SCORES = 200  # over all draws
_BISECTIONS = 5
_SEED = 0


@dataclass(frozen=True, eq=False)
class Others:
    """Units that another one is compared with, and how well they are known.

    Parameters
    ----------
    form : Form
    responses : ndarray, shape (unit, frequency, p, m), complex
        In scaled coordinates.
    noise : ndarray, shape (unit, frequency, p, m)
        Variances of the estimates.
    freqs_hz : ndarray, shape (frequency,), Hz
    rate : float
    found : Distances
        Of these units among themselves.
    """

    form: Form
    responses: Array
    noise: Array
    freqs_hz: Array
    rate: float
    found: Distances

    @classmethod
    def of(cls, form: Form, responses: Array, noise: Array, freqs_hz: Array, rate: float) -> Others:
        """Measure the distances of the units among themselves."""
        return cls(form, responses, noise, freqs_hz, rate, distances(form, responses, freqs_hz))

    def bounds(self, deviations: Array) -> tuple[float, float] | None:
        """Return the bound of a unit that is known as well as these, and of one with such estimation errors.

        Parameters
        ----------
        deviations : ndarray, shape (draw, frequency, p, m), complex

        Returns
        -------
        tuple of float, dB, or None
            The second is not below the first. None where the unit is known as well as these, or where there are too few of them for any bound.
        """
        variance = spread(deviations)
        if len(self.responses) <= LEAST_SCORES or times_noisier(variance, self.noise) <= AS_GOOD:
            return None
        usual = float(prediction_bound(excess(self.found.levels)[0], self.rate))
        return usual, max(usual, self._bound(deviations, variance))

    def more_data(self, deviations: Array, rise_db: float) -> float:
        """Return by how much longer recordings would bring the rise of the bound down to a size, variances falling as recordings grow."""
        low, high = 0.0, float(np.log(max(times_noisier(spread(deviations), self.noise), 1.0)))
        for _ in range(_BISECTIONS):
            middle = (low + high) / 2
            bounds = self.bounds(deviations * np.exp(-middle / 2))
            low, high = (low, middle) if bounds is None or bounds[1] - bounds[0] <= rise_db else (middle, high)
        return float(np.exp(high))

    def _bound(self, deviations: Array, variance: Array) -> float:
        """Bound of the others' scores when each is estimated as badly as the unit."""
        n, rng = len(self.responses), np.random.default_rng(_SEED)
        share = np.sqrt(np.clip(1 - np.divide(self.noise, variance, out=np.ones_like(self.noise), where=variance > 0), 0.0, 1.0))
        cover = covers(self.found.levels)
        rows = np.unique(np.linspace(0, n - 1, min(n, _MOST_UNITS)).round().astype(int))
        nominals = self.responses[rows]
        location, scale = [], []
        for _ in range(-(-_SCORES // len(rows))):
            drawn = deviations[rng.choice(len(deviations), len(rows), replace=len(deviations) < len(rows))]
            worse = self.responses[rows] + share[rows] * drawn
            levels = median_levels(self.form, nominals, worse, self.found, self.freqs_hz, np.eye(len(rows), dtype=bool))
            a, b = gumbel((levels - cover[rows]).max(axis=1))
            location.append(a)
            scale.append(b)
        return float(np.mean(location) + prediction_factor(n, self.rate) * np.mean(scale))


def spread(deviations: Array) -> Array:
    """Return the mean square of draws, shape (frequency, p, m)."""
    return np.asarray((np.abs(deviations) ** 2).mean(axis=0))


def times_noisier(variance: Array, noise: Array) -> float:
    """Return how many times the variance of one estimate is that of the middle one of others.

    Parameters
    ----------
    variance : ndarray, shape (frequency, p, m)
    noise : ndarray, shape (unit, frequency, p, m)

    Returns
    -------
    float
        The median over frequencies and entries; infinity where only the one has noise, zero where it has none.
    """
    middle = np.median(noise, axis=0)
    known = variance > 0
    if not known.any():
        return 0.0
    ratio = np.divide(variance, middle, out=np.full(variance.shape, np.inf), where=middle > 0)
    return float(np.median(ratio[known]))
