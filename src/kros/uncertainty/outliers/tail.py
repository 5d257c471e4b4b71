r"""Tail of outlier scores: which of the largest scores are too large for the others.

A score is a maximum over frequency, so the scores of good units are modelled as independent draws of a generalised extreme value distribution

    F_0(x) = exp(-(1 + xi x)^(-1 / xi)),        s = mu + beta x

with a fixed shape xi, location and scale unknown. They are measured by two statistics that move with both, the first two sample L-moments
(Hosking, *L-moments*, J. R. Stat. Soc. B 52, 1990): ``b = l2 / ln 2`` and ``a = l1 - gamma b``, location and scale themselves for xi = 0.
What is measured in them has a distribution that depends on the number of scores and xi alone: small samples get wider bounds, not wrong ones.
That distribution is drawn once, with a fixed seed:

    P(a score > a + q b) = rate              a and b of the n - 1 others

so under the model a good unit is flagged with a probability of at most `rate`. The shape was chosen on simulated drives, others than those
that the documented rates come from: with a normal model or xi = 0 more of them were flagged than the rate says.
"""

from __future__ import annotations

from functools import lru_cache
from typing import Any

import numpy as np
import numpy.typing as npt

Array = npt.NDArray[Any]

LEAST_SCORES = 3  # a location, a scale, and one that tests them
_NUMBERS = 4_000_000
SHAPE = 0.1  # xi
_HALVINGS = 55
_ASYMPTOTIC = 60  # from here on the correction of the factor is proportional to 1 / n


def prediction_bound(scores: Array, rate: float) -> Array:
    """Return what one further score exceeds with probability `rate`, from scores of shape (..., score), dB; infinity of fewer than three."""
    scores = np.asarray(scores, float)
    if scores.shape[-1] < LEAST_SCORES:
        return np.full(scores.shape[:-1], np.inf)
    location, scale = gumbel(scores)
    return np.asarray(location + prediction_factor(scores.shape[-1], rate) * scale)


@lru_cache(maxsize=256)
def prediction_factor(count: int, rate: float) -> float:
    """Return c of the bound ``a + c b``: the mean of ``1 - F_0(a_0 + c b_0)`` over statistics of standard draws is `rate`."""
    if count > _ASYMPTOTIC:
        limit = _limit(rate)
        return limit + (prediction_factor(_ASYMPTOTIC, rate) - limit) * _ASYMPTOTIC / count
    location, scale = gumbel(standard_draws(np.random.default_rng(0), (_NUMBERS // 40 // count, count)))

    def too_many(c: float) -> float:
        return float(np.log(exceedance(location + c * scale).mean() / rate))

    top = 2 * max(abs(_limit(rate)), 1.0)
    while too_many(top) > 0:
        top *= 2
    low, high = -top, top
    for _ in range(_HALVINGS):  # a root finder of SciPy would be done in ten steps, after half a second of loading
        middle = (low + high) / 2
        low, high = (middle, high) if too_many(middle) > 0 else (low, middle)
    return (low + high) / 2


def _limit(rate: float) -> float:
    """The factor for any number of scores: the quantile, in the statistics of the distribution itself."""
    from scipy.special import gamma

    quantile = np.expm1(-SHAPE * np.log(-np.log1p(-rate))) / SHAPE
    mean, second = (gamma(1 - SHAPE) - 1) / SHAPE, gamma(1 - SHAPE) * (2**SHAPE - 1) / SHAPE
    scale = second / np.log(2)
    return float((quantile - mean) / scale + np.euler_gamma)


def standard_draws(rng: np.random.Generator, shape: tuple[int, ...]) -> Array:
    """Return draws of F_0."""
    return np.expm1(SHAPE * rng.gumbel(size=shape)) / SHAPE


def exceedance(x: Array) -> Array:
    """Return ``1 - F_0``."""
    with np.errstate(divide="ignore"):
        log_power = np.log(np.maximum(1 + SHAPE * x, 0.0)) / SHAPE
    return np.asarray(-np.expm1(-np.exp(-np.maximum(log_power, -700.0))))


def gumbel(scores: Array) -> tuple[Array, Array]:
    """Return a and b over the last axis: the location and scale that the L-moments of a Gumbel distribution would have."""
    ordered = np.sort(scores, axis=-1)
    n = ordered.shape[-1]
    scale = ordered @ ((2 * np.arange(n) - n + 1) / (n * (n - 1))) / np.log(2)
    return ordered.mean(axis=-1) - np.euler_gamma * scale, scale


def leave_one_out_bounds(scores: Array, rate: float) -> Array:
    """Return for every score what it exceeds with probability `rate`, given the others; shape (score,), infinity with fewer than four."""
    n = len(scores)
    if n <= LEAST_SCORES:
        return np.full(n, np.inf)
    order = np.argsort(scores, kind="stable")
    x, rank, m = scores[order], np.arange(n), n - 1
    first = x.sum() - x
    above = x[::-1].cumsum()[::-1] - x
    second = (rank * x).sum() - rank * x - above
    scale = np.maximum((2 * second - (m - 1) * first) / (m * (m - 1)) / np.log(2), 0.0)
    bounds = np.empty(n)
    bounds[order] = first / m + (prediction_factor(m, rate) - np.euler_gamma) * scale
    return bounds
