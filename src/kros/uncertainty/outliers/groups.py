"""Scores of units from their distances, and the search for outliers one at a time and in groups that hide one another.

What goes in are levels in dB, shape (unit, frequency); each unit's excess over the g-th largest of the others makes its score, the tail model
of the scores tells which are too large.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from .tail import group_factors, group_statistics, gumbel

Array = npt.NDArray[Any]

_FLOOR_DB = 40.0
_ALIKE = 0.25  # of the gap below a group, what its members may differ by
_AMONG_OTHERS = 0.9  # of the factor; with it good units of populations that differ in gain alone are flagged at the rate, as others are


@dataclass(frozen=True, eq=False)
class Separation:
    """Inliers and outliers."""

    inliers: npt.NDArray[np.bool_]  # (unit,)
    # (unit,), dB: score minus the threshold of the step at which the unit went out, or of the last step; minus infinity where nothing
    # can be told
    margin_db: Array
    threshold_db: float  # dB: what the largest score of the inliers would have to exceed


def excess(levels: Array, size: int = 1) -> tuple[Array, Array]:
    """Return how far every unit exceeds the `size`-th largest of the others, and where.

    The largest excess of levels, shape (unit, frequency), over frequency in dB, and the index of its frequency. With size 1 the reference is the others'
    cover; with g a group of g that are alike no longer covers its members.
    """
    over = levels - covers(levels, size)
    where = over.argmax(axis=1)
    return over[np.arange(len(levels)), where], where


def covers(levels: Array, size: int = 1) -> Array:
    """Return what every unit is held against, shape (unit, frequency): the `size`-th largest of the others, at most 40 dB below its peak."""
    n = len(levels)
    ordered = np.partition(levels, (n - size - 1, n - size), axis=0)
    reference = np.where(levels >= ordered[n - size], ordered[n - size - 1], ordered[n - size])
    return held(reference)


def held(reference: Array) -> Array:
    """Return a cover, shape (..., frequency), held at 40 dB below its peak where it is lower: an excess over next to nothing is noise."""
    return np.maximum(reference, reference.max(axis=-1, keepdims=True) - _FLOOR_DB)


def separate(levels: Array, rate: float) -> Separation:
    """Take outliers out, the smallest group that is beyond its bound first, until none is.

    At most a third of the units goes. Of equal scores the first unit's counts as the larger one.
    """
    here = np.arange(len(levels))
    inliers, margin = np.ones(len(levels), bool), np.full(len(levels), -np.inf)
    while True:
        group, margins, threshold = _smallest_group(levels[here], rate, len(here) - (len(levels) - len(levels) // 3))
        margin[here] = margins
        if group.size == 0:
            return Separation(inliers, margin, threshold)
        inliers[here[group]] = False
        here = np.flatnonzero(inliers)


def _smallest_group(levels: Array, rate: float, most: int) -> tuple[Array, Array, float]:
    """Rows of a group of at most `most`, margins of all units and the threshold."""
    none, threshold, margins = np.array([], int), np.inf, np.full(len(levels), -np.inf)
    for size, factor in enumerate(group_factors(len(levels), rate), start=1):
        scores = excess(levels, size)[0]
        order = np.argsort(-scores, kind="stable")
        location, scale = gumbel(scores[order[size:]])
        bound = float(location + factor * scale)
        if size == 1:
            threshold, margins = bound, scores - bound
        if size <= most and group_statistics(scores)[size - 1] > factor and (size == 1 or _stands_apart(levels, order, size, factor)):
            return order[:size], scores - bound, bound
    return none, margins, threshold


def _stands_apart(levels: Array, order: Array, size: int, factor: float) -> bool:
    """Whether a group's members are alike, above a gap, or beyond the bound that the scores of the others make when the group is gone.

    The others' scores among all are lower by what the group is above them, so that one and the same gap counts twice: where all units have their
    largest excess at the same frequencies, as those that differ in nothing but gain, the upper ones of a good population would be such a group.
    """
    group, others = levels[order[:size]], levels[order[size:]]
    location, scale = gumbel(excess(others)[0])
    over = (group - held(others.max(axis=0))).max(axis=1)
    alike = np.ptp(over) < _ALIKE * over.min()
    return bool(alike or over.min() > location + _AMONG_OTHERS * factor * scale)
