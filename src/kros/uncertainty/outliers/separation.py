"""The search for outliers, one unit at a time, from levels in dB, shape (unit, frequency)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from .score import FEWEST_UNITS
from .tail import factor, scale, scales_without_one

Array = npt.NDArray[Any]
Flags = npt.NDArray[np.bool_]

_ROUNDING_DB = 1e-8  # levels are rounded to a tenth of that


@dataclass(frozen=True, eq=False)
class Separation:
    """Inliers and outliers."""

    inliers: Flags  # (unit,)
    # (unit,), dB: excess minus the threshold when the unit went out, or of the last step; minus infinity where nothing
    # can be told
    margin_db: Array
    threshold_db: float  # dB: what the largest excess of the inliers would have to exceed


def covers(levels: Array, inliers: Flags) -> Array:
    """Return the largest level of all inliers but the unit itself, over all frequencies, shape (unit,)."""
    peaks = levels.max(axis=1)
    first, second = -np.sort(-peaks[inliers])[:2]
    return np.where(
        inliers & (np.arange(len(peaks)) == np.flatnonzero(inliers)[peaks[inliers].argmax()]), second, first
    )


def margins(levels: Array, inliers: Flags, rate: float) -> tuple[Array, Array]:
    """Return every unit's excess over the inliers, itself left out."""
    known, value = levels[inliers], np.zeros(len(levels))
    if len(known) < 2:
        return value, np.full(len(levels), -np.inf)
    value, bound = levels.max(axis=1) - covers(levels, inliers), np.full(len(levels), np.inf)
    bound[~inliers] = factor(len(known), rate) * scale(known).mean()
    if len(known) > 2:
        bound[inliers] = factor(len(known) - 1, rate) * scales_without_one(known).mean(axis=1)
    return value, value - np.maximum(bound, _ROUNDING_DB)


def separate(levels: Array, rate: float) -> Separation:
    """Take units out while the largest excess is beyond the bound of the others."""
    n = len(levels)
    inliers, margin, most = np.ones(n, bool), np.full(n, -np.inf), n // 3
    if n < FEWEST_UNITS:
        return Separation(inliers, margin, np.inf)
    each = rate / (1 + n * rate)  # in expectation all steps together flag n * rate
    while True:
        value, beyond = margins(levels, inliers, each)
        top = int(np.argmax(np.where(inliers, value, -np.inf)))
        threshold = float(value[top] - beyond[top])
        margin[inliers] = value[inliers] - threshold
        if n - inliers.sum() >= most or not beyond[top] > 0:
            return Separation(inliers, margin, threshold)
        inliers[top] = False
