r"""What one further level may exceed the levels of others by: decibels of distances, or of innovations.

Distances of good units are taken to fall off no slower than a power, so that levels have an exponential tail of unknown
scale. The spacings of the levels ``x_1 >= x_2 >= ... >= x_n`` of n others estimate the scale, each weighted as if the
further level were above them (Renyi's representation):

    b = sum_j (j + 1) (x_j - x_(j+1)) / (n - 1) = (n (mean - x_n) + x_1 - x_n) / (n - 1)

A further level is the largest with probability ``1 / (n + 1)``, and is then above ``x_1`` by an exponential that does
not depend on the spacings; ``b / scale`` has the gamma distribution of mean one and shape ``n - 1``. So without any
simulation

    P(x > x_1 + t b) = rate        t = (n - 1) ((rate (n + 1))^(-1 / (n - 1)) - 1)

Levels of lighter tails (normal, bounded, of two suppliers) exceed this less often than `rate`. From a rate of 1 / (n +
1) on the bound is the largest level.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt

Array = npt.NDArray[Any]

LEAST_SCORES = 3


def prediction_bound(scores: Array, rate: float) -> Array:
    """Return what one further score exceeds with probability `rate`, from scores of shape (..., score), dB."""
    x = np.moveaxis(np.asarray(scores, float), -1, 0)
    if len(x) < LEAST_SCORES:
        return np.full(x.shape[1:], np.inf)
    return np.asarray(x.max(axis=0) + factor(len(x), rate) * scale(x))


def factor(count: int, rate: float) -> float:
    """Return t for `count` others, at least two."""
    return float(max((count - 1) * np.expm1(-np.log(rate * (count + 1)) / (count - 1)), 0.0))


def scale(levels: Array) -> Array:
    """Return b over the first axis, of at least two levels."""
    return _scale(len(levels), levels.sum(axis=0), levels.min(axis=0), levels.max(axis=0))


def scales_without_one(levels: Array) -> Array:
    """Return b of all but one for each of at least three levels, of the shape of `levels`."""
    ordered, rows = np.sort(levels, axis=0), np.arange(len(levels)).reshape(-1, *[1] * (levels.ndim - 1))
    least = np.where(rows == levels.argmin(axis=0), ordered[1], ordered[0])
    largest = np.where(rows == levels.argmax(axis=0), ordered[-2], ordered[-1])
    return _scale(len(levels) - 1, levels.sum(axis=0) - levels, least, largest)


def _scale(count: int, total: Array, least: Array, largest: Array) -> Array:
    return np.asarray(np.maximum(total - count * least + largest - least, 0.0) / (count - 1))
