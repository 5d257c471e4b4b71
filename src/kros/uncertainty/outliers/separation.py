"""The search for outliers, one unit at a time: levels in dB, shape (unit, frequency), and each unit's excess over the largest of the others."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from .tail import LEAST_SCORES, gumbel, prediction_factor

Array = npt.NDArray[Any]

_FLOOR_DB = 40.0
_SHARE = 0.75  # of the rate, for the search takes several steps


@dataclass(frozen=True, eq=False)
class Separation:
    """Inliers and outliers."""

    inliers: npt.NDArray[np.bool_]  # (unit,)
    # (unit,), dB: score minus the threshold of the step at which the unit went out, or of the last step; minus infinity where nothing
    # can be told
    margin_db: Array
    threshold_db: float  # dB: what the largest score of the inliers would have to exceed


def excess(levels: Array) -> tuple[Array, Array]:
    """Return how far every unit exceeds the largest of the others, dB, and the index of the frequency where it does most."""
    over = levels - covers(levels)
    where = over.argmax(axis=1)
    return over[np.arange(len(levels)), where], where


def covers(levels: Array) -> Array:
    """Return what every unit is held against, shape (unit, frequency): the largest of the others, at most 40 dB below its peak."""
    n = len(levels)
    ordered = np.partition(levels, (n - 2, n - 1), axis=0)
    return held(np.where(levels >= ordered[n - 1], ordered[n - 2], ordered[n - 1]))


def held(reference: Array) -> Array:
    """Return a cover, shape (..., frequency), held at 40 dB below its peak where it is lower: an excess over next to nothing is noise."""
    return np.maximum(reference, reference.max(axis=-1, keepdims=True) - _FLOOR_DB)


def separate(levels: Array, rate: float) -> Separation:
    """Take units out while the largest score is beyond the bound of the others; at most a third goes, of equal scores the first."""
    here, most = np.arange(len(levels)), len(levels) // 3
    inliers, margin = np.ones(len(levels), bool), np.full(len(levels), -np.inf)
    while len(here) > LEAST_SCORES:
        scores = excess(levels[here])[0]
        top = int(np.argmax(scores))
        location, scale = gumbel(np.delete(scores, top))
        factor = prediction_factor(len(here) - 1, _SHARE * rate)
        threshold = float(location + factor * scale)
        margin[here] = scores - threshold
        rounding = np.finfo(float).eps * np.abs(scores).max()
        if len(levels) - len(here) >= most or not scores[top] - location > max(factor * scale, rounding):
            return Separation(inliers, margin, threshold)
        inliers[here[top]] = False
        here = np.flatnonzero(inliers)
    margin[here] = -np.inf
    return Separation(inliers, margin, np.inf)
