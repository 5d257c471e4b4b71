"""How sure a mean over units is: resampling units, not samples, since units are what differs."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from ..core.errors import DataError

Array = npt.NDArray[np.float64]


def unit_interval(values: npt.ArrayLike, share: float = 0.95, draws: int = 4000, seed: int = 0) -> tuple[Array, Array]:
    """Return the percentile bootstrap interval of the mean over units.

    Parameters
    ----------
    values : array_like, shape (unit, ...)
        One number a unit, such as its mean error.
    share : float
        Probability that the interval is meant to hold.
    draws : int
    seed : int

    Returns
    -------
    lower, upper : ndarray, shape (...)

    Raises
    ------
    DataError
        With fewer than two units, where nothing can be resampled.

    References
    ----------
    B. Efron and R. J. Tibshirani, An Introduction to the Bootstrap, Chapman & Hall 1993, chapter 13.
    """
    values = np.asarray(values, dtype=float)
    if values.ndim < 1 or len(values) < 2 or not 0 < share < 1:
        raise DataError(f"Bootstrap over units: needs at least 2 units and a share between 0 and 1, found {values.shape} and {share}.")
    rows = np.random.default_rng(seed).integers(len(values), size=(draws, len(values)))
    places = rows + len(values) * np.arange(draws)[:, None]
    counts = np.bincount(places.ravel(), minlength=draws * len(values)).reshape(draws, len(values)) / len(values)
    means = np.tensordot(counts, values, 1)
    lower, upper = np.quantile(means, [(1 - share) / 2, (1 + share) / 2], axis=0)
    return np.asarray(lower), np.asarray(upper)


def draw_interval(values: npt.ArrayLike, share: float = 0.95, draws: int = 4000, seed: int = 0) -> tuple[Array, Array]:
    """Return the interval of the mean over units that were drawn anew, each with one of its noise realisations.

    Parameters
    ----------
    values : array_like, shape (realisation, unit, ...)
    share : float
    draws : int
    seed : int

    Returns
    -------
    lower, upper : ndarray, shape (...)
        It is wider than `unit_interval` of the means over realisations by what one realisation tells differently from another.

    Raises
    ------
    DataError
        With fewer than two units or realisations.
    """
    values = np.asarray(values, dtype=float)
    if values.ndim < 2 or min(values.shape[:2]) < 2 or not 0 < share < 1:
        raise DataError(
            f"Bootstrap over units and noise: needs at least 2 realisations of 2 units and a share between 0 and 1, found {values.shape} and {share}."
        )
    rng = np.random.default_rng(seed)
    n_draws, n_units = values.shape[:2]
    means = values[rng.integers(n_draws, size=(draws, n_units)), rng.integers(n_units, size=(draws, n_units))].mean(axis=1)
    lower, upper = np.quantile(means, [(1 - share) / 2, (1 + share) / 2], axis=0)
    return np.asarray(lower), np.asarray(upper)
