"""What one further level may exceed the levels of others by, and the search for units that do.

Distances of good units are taken to fall off no slower than a power, so that levels have an exponential tail of unknown
scale. The spacings of the levels ``x_1 >= x_2 >= ... >= x_n`` of n others estimate the scale, each weighted as if the
further level were above them (Renyi's representation):

    b = sum_j (j + 1) (x_j - x_(j+1)) / (n - 1) = (n (mean - x_n) + x_1 - x_n) / (n - 1)

A further level is the largest with probability ``1 / (n + 1)``, and is then above ``x_1`` by an exponential that does
not depend on the spacings; ``b / scale`` has the gamma distribution of mean one and shape ``n - 1``. So without any
simulation

    P(x > x_1 + t b) = rate        t = (n - 1) ((rate (n + 1))^(-1 / (n - 1)) - 1)

Levels of lighter tails (normal, bounded, of two suppliers) exceed this less often than `rate`. From a rate of 1 / (n +
1) on the bound is the largest level. The search takes units out one at a time, from levels in dB (unit, frequency).
"""

from typing import NamedTuple

import numpy as np

from ...core import AnyArray, Flags
from ..settings import OUTLIER

LEAST_SCORES = 3


def prediction_bound(scores: AnyArray, rate: float) -> AnyArray:
    """Return what one further score exceeds with probability `rate`, from scores of shape (..., score), dB."""
    x = np.moveaxis(scores, -1, 0)
    if len(x) < LEAST_SCORES:
        return np.full(x.shape[1:], np.inf)
    return x.max(axis=0) + factor(len(x), rate) * scale(x)


def factor(count: int, rate: float) -> float:
    """Return t for `count` others, at least two."""
    return float(max((count - 1) * np.expm1(-np.log(rate * (count + 1)) / (count - 1)), 0.0))


def scale(levels: AnyArray) -> AnyArray:
    """Return b over the first axis, of at least two levels."""
    count, least = len(levels), levels.min(axis=0)
    return np.maximum(levels.sum(axis=0) - count * least + levels.max(axis=0) - least, 0.0) / (count - 1)


def excesses(peaks: AnyArray, inliers: Flags) -> AnyArray:
    """Return what largest levels (..., unit) exceed those of all inliers but the unit itself by; NaN is no level."""
    known = np.where(inliers & np.isfinite(peaks), peaks, -np.inf)
    second, first = np.moveaxis(np.sort(known, axis=-1)[..., -2:], -1, 0)
    largest = np.arange(peaks.shape[-1]) == known.argmax(axis=-1)[..., None]
    return peaks - np.where(largest, second[..., None], first[..., None])


def margins(levels: AnyArray, inliers: Flags, rate: float) -> tuple[AnyArray, AnyArray]:
    """Return every unit's excess over two inliers or more, itself left out, and how far that is beyond their bound."""
    known, count = levels[inliers], int(inliers.sum())
    value, bound = excesses(levels.max(axis=1), inliers), np.full(len(levels), np.inf)
    bound[~inliers] = factor(count, rate) * scale(known).mean()
    if count > 2:
        others = [scale(np.delete(known, row, axis=0)).mean() for row in range(count)]
        bound[inliers] = factor(count - 1, rate) * np.array(others)
    return value, value - np.maximum(bound, OUTLIER.rounding_db)


class Separation(NamedTuple):
    """Inliers and outliers."""

    inliers: Flags  # (unit,)
    margin_db: AnyArray  # (unit,), dB: beyond the bound when the unit went out, or at last
    threshold_db: float  # dB: what the largest excess of the inliers would have to exceed


def separate(levels: AnyArray, rate: float) -> Separation:
    """Take units out while the largest excess is beyond the bound of the others, up to a third of them."""
    n = len(levels)
    inliers, margin = np.ones(n, bool), np.full(n, -np.inf)
    if n < OUTLIER.fewest:
        return Separation(inliers, margins(levels, inliers, rate)[1], np.inf)
    each = rate / (1 + n * rate)  # in expectation all steps together flag n * rate
    while True:
        value, beyond = margins(levels, inliers, each)
        top = int(np.argmax(np.where(inliers, value, -np.inf)))
        threshold = float(value[top] - beyond[top])
        margin[inliers] = value[inliers] - threshold
        if n - inliers.sum() >= n // 3 or not beyond[top] > 0:
            return Separation(inliers, margin, threshold)
        inliers[top] = False
