"""What the errors of units that took part in nothing say about the next one: split conformal prediction.

Of ``n`` units that nothing was made from, and one more that is exchangeable with them, every order of their errors is
equally likely. So the error of the next unit is at most the ``ceil(confidence (n + 1))``-th smallest of theirs with a
probability of at least ``confidence``, whatever their distribution, the observer or the plant. Several errors are
bounded together by the largest one relative to a scale that was fixed before.

Source: V. Vovk, A. Gammerman and G. Shafer, Algorithmic Learning in a Random World, Springer 2005, section 4.2; H.
Papadopoulos et al., Inductive Confidence Machines for Regression, ECML 2002.
"""

from __future__ import annotations

from collections.abc import Sequence
from math import ceil

import numpy as np

from ..core.arrays import Array, ArrayLike
from ..core.errors import DataError
from ..core.rounding import ITERATED


def draw_reserve(units: Sequence[str], n: int, seed: int = 0) -> tuple[str, ...]:
    """Draw units that take part in nothing, by place alone; more of them include fewer."""
    drawn = np.random.default_rng(seed).permutation(len(units))[:n]
    return tuple(units[i] for i in sorted(drawn))


def fewest_units(confidence: float) -> int:
    """Return how many units bound the next one: ``1 / (1 - confidence) - 1``, rounded up."""
    return ceil(confidence / (1 - confidence) - ITERATED)  # 0.9 / (1 - 0.9) is a little more than 9


def next_unit_bound(errors: ArrayLike, scale: ArrayLike, confidence: float = 0.95) -> Array | None:
    """Bound the errors of the next unit, (k,), all of them together; None with fewer units than `fewest_units`."""
    errors, scale = np.asarray(errors, dtype=float), np.asarray(scale, dtype=float)
    if not (np.isfinite(scale) & (scale > 0)).all():
        raise DataError(f"Bound of the next unit: a scale is positive and finite, found {scale.tolist()}.")
    if len(errors) < fewest_units(confidence):
        return None
    scores = np.max(np.where(np.isfinite(errors), errors, np.inf) / scale, axis=1)
    rank = ceil(confidence * (len(errors) + 1) - ITERATED)
    return np.sort(scores)[rank - 1] * scale
