"""How sure a mean error over units is: bootstrap over units, not samples, since units are what differs.

Source: B. Efron and R. J. Tibshirani, An Introduction to the Bootstrap, Chapman & Hall 1993, chapter 13.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from ..core.arrays import Array, ArrayLike
from ..core.errors import DataError

Row = Mapping[str, Any]
_CELL = ("observer", "condition", "channel")


def unit_interval(values: ArrayLike, draws: int = 4000, seed: int = 0) -> tuple[Array, Array]:
    """Return the 95 % percentile bootstrap interval of the mean over units.

    Parameters
    ----------
    values : array_like, shape (unit, ...)
        One number a unit, such as its mean error.
    draws, seed : int

    Returns
    -------
    lower, upper : ndarray, shape (...)

    Raises
    ------
    DataError
        With fewer than two units, where nothing can be resampled.

    Examples
    --------
    >>> import numpy as np
    >>> from kros.evaluate import unit_interval
    >>> lower, upper = unit_interval(np.linspace(1.0, 2.0, 20))
    >>> bool(lower < 1.5 < upper)
    True
    """
    from scipy.stats import bootstrap

    values = np.asarray(values, dtype=float)
    if values.ndim < 1 or len(values) < 2:
        raise DataError(f"Bootstrap over units: needs at least 2 units, found values of shape {values.shape}.")
    rng = np.random.default_rng(seed)
    result = bootstrap((values,), np.mean, n_resamples=draws, method="percentile", rng=rng)
    return result.confidence_interval.low, result.confidence_interval.high


def interval_rows(rows: Sequence[Row]) -> list[dict[str, Any]]:
    """Return the 95 % ``interval`` of the mean error over at least three units, by observer, condition and channel."""
    errors: dict[tuple[str, ...], dict[str, Any]] = {}
    for row in (row for row in rows if row["role"] == "off_nominal"):
        errors.setdefault(tuple(row[name] for name in _CELL), {})[row["unit"]] = row["error_percent"]
    intervals = []
    for cell, by_unit in errors.items():
        values = [by_unit[unit] for unit in sorted(by_unit)]
        if len(values) > 2 and all(value is not None and np.isfinite(value) for value in values):
            lower, upper = unit_interval(values)
            interval = [float(lower), float(upper)]
            intervals.append({**dict(zip(_CELL, cell, strict=True)), "role": "off_nominal", "interval": interval})
    return intervals
