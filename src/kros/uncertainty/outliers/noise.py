r"""What the noise of a unit's own estimate makes of a good unit: the bound of a unit that was recorded less than the others.

Scores of units compare estimates that are equally good. A unit that was recorded less scatters more, and exceeds the others for that alone. Its
bound comes from the others, estimated as badly as it was:

    G_i + s_i dG,       s_i^2 = max(0, 1 - var_i / var)        entry by entry, frequency by frequency

with dG a draw of the unit's own estimation error, var its variance and var_i that of unit i, which has some of it already. Each such estimate is
scored against the cover of the others as they are. Location and scale are measured on these scores, averaged over draws, and the bound is that
of the tail model at the same rate (`tail`). With equal variances nothing is added and the bound is the usual one.

The unit itself is in the cover of the others, as everywhere, but only with what is left of its distance without a level of noise that few draws exceed:
a unit that is far off for its noise alone would lower the scores that it is compared with.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from ..forms import Form
from .distances import Distances, distances, median_levels, scaled_levels
from .groups import covers
from .tail import LEAST_SCORES, gumbel, prediction_bound, prediction_factor

Array = npt.NDArray[Any]

AS_GOOD = 1.25  # ratio of variances up to which estimates count as equally good: 1 dB
_MOST_UNITS = 24  # that are estimated badly, and that are nominals for them
_SCORES = 200  # over all draws
_BISECTIONS = 5
_SEED = 0
_TINY = 1e-30
_LARGE = 0.95  # quantile of the noise that is taken off a unit's distance


@dataclass(frozen=True, eq=False)
class Others:
    """Units that another one is compared with, and how well they are known."""

    form: Form
    responses: Array  # (unit, frequency, p, m), complex, in scaled coordinates
    noise: Array  # variances of the estimates, of the same shape
    freqs_hz: Array
    rate: float
    found: Distances  # of these units among themselves

    @classmethod
    def of(cls, form: Form, responses: Array, noise: Array, freqs_hz: Array, rate: float, found: Distances | None = None) -> Others:
        """Measure the distances of the units among themselves, where they are not known."""
        return cls(form, responses, noise, freqs_hz, rate, distances(form, responses, freqs_hz) if found is None else found)

    def bounds(self, response: Array, deviations: Array) -> tuple[float, float] | None:
        """Return the bound of a unit that is known as well as these, and of one with such estimation errors.

        From its response, shape (frequency, p, m), and draws of its errors, shape (draw, frequency, p, m). The second is not below the first; None where the
        unit is known as well as these, or where there are too few of them for any bound.
        """
        variance = spread(deviations)
        if len(self.responses) <= LEAST_SCORES or times_noisier(variance, self.noise) <= AS_GOOD:
            return None
        rows = np.unique(np.linspace(0, len(self.responses) - 1, min(len(self.responses), _MOST_UNITS)).round().astype(int))
        worse = np.stack([self._worse(rows, deviations, variance, draw) for draw in range(-(-_SCORES // len(rows)))])
        noise = np.quantile(scaled_levels(self.form, self.responses[rows], worse, self.found, self.freqs_hz), _LARGE, axis=(0, 1))
        cover = covers(np.concatenate([self.found.levels, self._beyond(response, rows, noise)[None]]))[:-1]
        usual = float(prediction_bound((self.found.levels - cover).max(axis=1), self.rate))
        own = np.eye(len(rows), dtype=bool)
        levels = [median_levels(self.form, self.responses[rows], w, self.found, self.freqs_hz, own) for w in worse]
        location, scale = gumbel((np.stack(levels) - cover[rows]).max(axis=2))
        noisy = float(location.mean() + prediction_factor(len(self.responses), self.rate) * scale.mean())
        return usual, max(usual, noisy)

    def more_data(self, response: Array, deviations: Array, rise_db: float) -> float:
        """Return by how much longer recordings would bring the rise of the bound down to a size, variances falling as recordings grow."""
        low, high = 0.0, float(np.log(max(times_noisier(spread(deviations), self.noise), 1.0)))
        for _ in range(_BISECTIONS):
            middle = (low + high) / 2
            bounds = self.bounds(response, deviations * np.exp(-middle / 2))
            low, high = (low, middle) if bounds is None or bounds[1] - bounds[0] <= rise_db else (middle, high)
        return float(np.exp(high))

    def _worse(self, rows: Array, deviations: Array, variance: Array, draw: int) -> Array:
        """Some units, estimated as badly as a unit with such errors."""
        share = np.sqrt(
            np.clip(1 - np.divide(self.noise[rows], variance, out=np.ones(self.noise[rows].shape), where=variance > 0), 0.0, 1.0)
        )
        chosen = np.random.default_rng([_SEED, draw]).choice(len(deviations), len(rows), replace=len(deviations) < len(rows))
        return self.responses[rows] + share * deviations[chosen]

    def _beyond(self, response: Array, rows: Array, noise: Array) -> Array:
        """Level of a unit without a level of noise, shape (frequency,), dB."""
        none = np.zeros((len(rows), 1), dtype=bool)
        level = median_levels(self.form, self.responses[rows], response[None], self.found, self.freqs_hz, none)[0]
        rest = 10 ** (level / 10) - 10 ** (noise / 10)
        return np.where(rest > 0, 10 * np.log10(np.maximum(rest, _TINY)), self.found.levels.min())


def spread(deviations: Array) -> Array:
    """Return the mean square of draws, shape (frequency, p, m)."""
    return np.asarray((np.abs(deviations) ** 2).mean(axis=0))


def times_noisier(variance: Array, noise: Array) -> float:
    """Return how many times the variance of one estimate is that of the middle one of others.

    The median over frequencies and entries; infinity where only the one has noise, zero where it has none.
    """
    return noisier_than(np.median(noise, axis=0), variance)


def noisier_than(middle: Array, variance: Array) -> float:
    """Return the same of the middle one's variance, shape (frequency, p, m)."""
    known = variance > 0
    if not known.any():
        return 0.0
    ratio = np.divide(variance, middle, out=np.full(variance.shape, np.inf), where=middle > 0)
    return float(np.median(ratio[known]))
