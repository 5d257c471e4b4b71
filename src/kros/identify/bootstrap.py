"""Uncertainty of the estimate itself: models of resampled episodes, from what each episode was reduced to.

    per-episode factors --draw episodes--> weighted restacking --EDMD--> samples of (A, B)

Whole episodes are drawn, since samples of one episode depend on each other. Of E episodes E - 1 are drawn with
replacement and each counts E / (E - 1) times as often as it was drawn: drawing E of E would give (E - 1) / E of the
variance (Rao and Wu, J. Am. Stat. Assoc. 83, 1988). `alpha` and the calibrated parameters stay as they are; a bias that
all episodes share is not seen.

Symbols
-------
w : weights of the episodes, (unit, draw, episode)
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from ..core.arrays import AnyArray, Array, frozen
from ..core.errors import DataError
from ..core.linalg import qr_triangle
from .edmd import KoopmanMatrices, edmd


@frozen
class ModelSamples:
    """Models of resampled episodes around an estimate."""

    unit_ids: tuple[str, ...]
    estimate: KoopmanMatrices  # A (unit, n, n) and B (unit, n, m)
    samples: KoopmanMatrices  # A (unit, draw, n, n) and B (unit, draw, n, m)

    def responses(self, row: int, freqs_hz: Array, sample_period_s: float) -> AnyArray:
        """Return frequency responses of one unit's samples, shape (draw, frequency, n, m)."""
        return KoopmanMatrices(self.samples.A[row], self.samples.B[row]).responses(freqs_hz, sample_period_s)


def episode_weights(n_episodes: Sequence[int], draws: int, seed: int) -> Array:
    """Draw E - 1 of E episodes with replacement, and return how much each counts: (unit, draw, max(n_episodes))."""
    counts = [int(e) for e in n_episodes]
    if not counts or min(counts) < 2 or draws < 2:
        raise DataError(
            f"Resampling episodes: needs at least two episodes of every unit and two draws, found {counts} episodes of "
            f"the units and {draws} draws; record more, or leave the unit out."
        )
    weights = np.zeros((len(counts), draws, max(counts)))
    for row, E in enumerate(counts):
        rng = np.random.default_rng([seed, row])
        weights[row, :, :E] = rng.multinomial(E - 1, np.full(E, 1 / E), size=draws) * (E / (E - 1))
    return weights


def bootstrap_edmd(
    R: Array, n_lifted: int, alpha: float, weights: Array, unit_ids: Sequence[str] | None = None
) -> ModelSamples:
    """Return EDMD models of resampled episodes at a fixed alpha, from factors (unit, episode, k, k) and weights."""
    units, episodes, width, _ = R.shape
    models = []
    for draw in [np.ones((units, episodes)), *np.swapaxes(weights, 0, 1)]:
        stacked = (np.sqrt(draw)[..., None, None] * R).reshape(units, episodes * width, width)
        models.append(edmd(qr_triangle(stacked), n_lifted, alpha))
    drawn = KoopmanMatrices(*(np.stack([getattr(m, name) for m in models[1:]], axis=1) for name in ("A", "B")))
    ids = tuple(map(str, range(units) if unit_ids is None else unit_ids))
    return ModelSamples(ids, models[0], drawn)
