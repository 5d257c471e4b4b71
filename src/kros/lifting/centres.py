"""Centres of radial basis functions: on a grid, spread at random from a seed, or where the data are."""

from __future__ import annotations

import math
from collections.abc import Sequence
from itertools import product

import numpy as np
import numpy.typing as npt

from ..core.errors import ConfigError
from .families import is_whole, require_count

Array = npt.NDArray[np.float64]
_ROUNDS = 100
_STARTS = 8


def grid_centres(ranges: Sequence[Sequence[float]], counts: Sequence[int]) -> Array:
    """Return a uniform grid that includes the ends of the ranges, shape (product of counts, d).

    Parameters
    ----------
    ranges : sequence of (lower, upper)
    counts : sequence of int
        Points along every dimension; one point stands in the middle.

    Examples
    --------
    >>> from kros.lifting import grid_centres
    >>> grid_centres([(0, 1), (-1, 1)], [2, 3]).tolist()
    [[0.0, -1.0], [0.0, 0.0], [0.0, 1.0], [1.0, -1.0], [1.0, 0.0], [1.0, 1.0]]
    """
    box = _box(ranges)
    if len(counts) != len(box) or not all(is_whole(c, 1) for c in counts):
        raise ConfigError(
            f"Grid of centres: counts = {list(counts)} should be one whole number of at least 1 for each of {len(box)} ranges."
        )
    require_count("grid of centres", math.prod(int(c) for c in counts))
    axes = [np.linspace(low, high, int(c)) if c > 1 else np.array([(low + high) / 2]) for (low, high), c in zip(box, counts, strict=True)]
    return np.array(list(product(*axes)))


def random_centres(ranges: Sequence[Sequence[float]], n: int, seed: int) -> Array:
    """Return independent uniform centres, shape (n, d).

    Examples
    --------
    >>> from kros.lifting import random_centres
    >>> random_centres([(0, 1), (-1, 1)], n=5, seed=0).shape
    (5, 2)
    """
    box = _box(ranges)
    return np.random.default_rng(seed).uniform(box[:, 0], box[:, 1], size=(_count(n), len(box)))


def latin_hypercube_centres(ranges: Sequence[Sequence[float]], n: int, seed: int) -> Array:
    """Return centres of which every dimension has exactly one in each of n equal slices, shape (n, d).

    Examples
    --------
    >>> from kros.lifting import latin_hypercube_centres
    >>> sorted(int(x) for x in latin_hypercube_centres([(0, 4)], n=4, seed=0).ravel())  # one in every quarter
    [0, 1, 2, 3]
    """
    from scipy.stats import qmc

    box = _box(ranges)
    unit = qmc.LatinHypercube(len(box), rng=np.random.default_rng(seed)).random(_count(n))
    return np.asarray(box[:, 0] + unit * (box[:, 1] - box[:, 0]))


def kmeans_centres(data: npt.ArrayLike, n: int, seed: int) -> Array:
    """Return the means of n clusters of data, shape (n, d), the best of eight starts; dimensions count in units of their standard deviation.

    Parameters
    ----------
    data : array_like, shape (n_samples, d)
    n : int
    seed : int

    Examples
    --------
    >>> from kros.lifting import kmeans_centres
    >>> sorted(kmeans_centres([[0.0], [0.2], [9.0], [9.2]], n=2, seed=0).round(9).ravel().tolist())
    [0.1, 9.1]
    """
    from scipy.cluster.vq import ClusterError, kmeans2

    data = np.asarray(data, dtype=float)
    if data.ndim != 2 or not np.isfinite(data).all():
        raise ConfigError(f"Centres by k-means: need finite data of shape (n_samples, d), found shape {data.shape}.")
    distinct = np.unique(data, axis=0)
    if len(distinct) < _count(n):
        raise ConfigError(f"Centres by k-means: {n} clusters need as many different samples, found {len(distinct)}; ask for fewer.")
    spread = data.std(axis=0)
    spread[spread == 0] = 1.0
    rng, scaled = np.random.default_rng(seed), data / spread
    best: tuple[float, Array] | None = None
    for _ in range(_STARTS):
        try:
            means, label = kmeans2(scaled, n, iter=_ROUNDS, minit="++", missing="raise", rng=rng)
        except ClusterError:
            continue
        error = float(np.sum((scaled - means[label]) ** 2))
        if best is None or error < best[0]:
            best = error, np.asarray(means * spread)
    if best is None:
        raise ConfigError(f"Centres by k-means: in {_STARTS} starts one of {n} clusters was empty; ask for fewer.")
    return best[1]


def _box(ranges: Sequence[Sequence[float]]) -> Array:
    try:
        box = np.asarray(ranges, dtype=float)
    except (TypeError, ValueError) as error:
        raise ConfigError(f"Centres: ranges = {ranges!r} should be pairs of a lower and an upper number.") from error
    if box.ndim != 2 or box.shape[1] != 2 or not np.isfinite(box).all() or not np.all(box[:, 0] < box[:, 1]):
        raise ConfigError(f"Centres: ranges = {ranges!r} should be one pair of a lower and an upper number for every quantity.")
    return box


def _count(n: int) -> int:
    if not is_whole(n, 1):
        raise ConfigError(f"Centres: n = {n!r} should be a whole number of at least 1.")
    require_count("centres", n)
    return int(n)
