"""Gaussian radial basis functions, their centres, and random Fourier features, as formulas."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import numpy.typing as npt

from ..core.errors import ConfigError
from .families import Formulas, is_whole, number, require_count, require_names, wrapped

Array = npt.NDArray[np.float64]
_ROUNDS = 100
_STARTS = 8


def radial(names: Sequence[str], centres: npt.ArrayLike, length: float | Sequence[float]) -> Formulas:
    """Return ``exp(-s**2/2)`` for every centre c, of the scaled distance ``s**2 = sum_i ((q_i - c_i)/length_i)**2``.

    Parameters
    ----------
    names : sequence of str
        Quantities, or formulas, that span the space; d of them.
    centres : array_like, shape (n_centres, d)
        In the units of the quantities; see `kmeans_centres`.
    length : float or sequence of float, shape (d,)
        Length scale of every quantity, in its unit.

    Returns
    -------
    tuple of str

    Examples
    --------
    >>> radial(["position", "velocity"], [[0.5, 0]], [0.1, 2])
    ('exp(-(((position - 0.5)/0.1)**2 + (velocity/2)**2)/2)',)
    """
    names = require_names("radial", names)
    lengths = length_scales("radial", length, len(names))
    centres = np.asarray(centres, dtype=float)
    if centres.ndim != 2 or centres.shape[1] != len(names) or not len(centres) or not np.isfinite(centres).all():
        raise ConfigError(
            f"radial: centres for {list(names)} should be finite and have the shape (n, {len(names)}), found shape {centres.shape}."
        )
    return tuple(f"exp(-({_squared_distance(names, centre, lengths)})/2)" for centre in centres)


def fourier_features(names: Sequence[str], n: int, length: float | Sequence[float], seed: int) -> Formulas:
    """Return random Fourier features ``sqrt(2/n)*cos(w*q + b)``, whose inner product tends to the Gaussian kernel as n grows.

    The kernel is ``exp(-s**2/2)`` with the scaled distance s, as in `radial`.

    Parameters
    ----------
    names : sequence of str
        Quantities, or formulas; d of them.
    n : int
    length : float or sequence of float, shape (d,)
    seed : int

    References
    ----------
    A. Rahimi and B. Recht, "Random features for large-scale kernel machines", Advances in Neural Information Processing Systems 20, 2007.

    Examples
    --------
    >>> from kros.lifting import fourier_features
    >>> len(fourier_features(["angle", "rate"], n=20, length=[0.5, 2.0], seed=0))
    20
    """
    names = require_names("fourier", names)
    lengths = length_scales("fourier", length, len(names))
    if not is_whole(n, 1):
        raise ConfigError(f"fourier: n = {n!r} should be a whole number of at least 1.")
    require_count("fourier", n)
    rng = np.random.default_rng(seed)
    frequencies = rng.standard_normal(size=(int(n), len(names))) / lengths
    shifts = rng.uniform(0, 2 * np.pi, size=int(n))
    size = number(np.sqrt(2 / n))
    return tuple(
        f"{size}*cos({' + '.join(f'({number(w)})*{wrapped(name)}' for w, name in zip(row, names, strict=True))} + {number(b)})"
        for row, b in zip(frequencies, shifts, strict=True)
    )


def length_scales(family: str, length: float | Sequence[float], n: int) -> Array:
    """Return n length scales from one or n, refusing what is not positive."""
    lengths = np.asarray(length, dtype=float)
    if lengths.shape not in ((), (n,)) or not np.isfinite(lengths).all() or np.any(lengths <= 0):
        raise ConfigError(
            f"{family}: length = {length} should be a positive number, or {n} of them, one for each quantity."
        )
    return np.broadcast_to(lengths, (n,))


def _squared_distance(names: Sequence[str], centre: Array, lengths: Array) -> str:
    terms = []
    for name, c, scale in zip(names, centre, lengths, strict=True):
        offset = wrapped(name) if c == 0 else f"({wrapped(name)} {'-' if c > 0 else '+'} {number(abs(c))})"
        terms.append(f"({offset}/{number(scale)})**2" if scale != 1 else f"{offset}**2")
    return " + ".join(terms)


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
        raise ConfigError(
            f"Centres by k-means: {n} clusters need as many different samples, found {len(distinct)}; ask for fewer."
        )
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


def _count(n: int) -> int:
    if not is_whole(n, 1):
        raise ConfigError(f"Centres: n = {n!r} should be a whole number of at least 1.")
    require_count("centres", n)
    return int(n)
