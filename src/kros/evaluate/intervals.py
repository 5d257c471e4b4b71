"""How sure a mean error over units is: bootstrap over units, not samples, since units are what differs.

Source: B. Efron and R. J. Tibshirani, An Introduction to the Bootstrap, Chapman & Hall 1993, chapter 13.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import numpy.typing as npt

from ..core.errors import DataError

Array = npt.NDArray[np.float64]
Cell = tuple[str, str, str]
_ENDS = (0.025, 0.975)
_FEWEST = 3  # units: of two there are three resamples


def unit_interval(values: npt.ArrayLike, draws: int = 4000, seed: int = 0) -> tuple[Array, Array]:
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
    values = np.asarray(values, dtype=float)
    if values.ndim < 1 or len(values) < 2:
        raise DataError(f"Bootstrap over units: needs at least 2 units, found values of shape {values.shape}.")
    rows = np.random.default_rng(seed).integers(len(values), size=(draws, len(values)))
    places = rows + len(values) * np.arange(draws)[:, None]
    counts = np.bincount(places.ravel(), minlength=draws * len(values)).reshape(draws, len(values)) / len(values)
    return _interval(np.tensordot(counts, values, 1))


def _interval(means: Array) -> tuple[Array, Array]:
    lower, upper = np.quantile(means, _ENDS, axis=0)
    return np.asarray(lower), np.asarray(upper)


def mean_intervals(rows: Sequence[Mapping[str, Any]], role: str = "off_nominal") -> dict[Cell, tuple[float, float]]:
    """Return the 95 % interval of the mean error over units, by observer, condition and channel."""
    found: dict[Cell, dict[str, float | None]] = {}
    for row in rows:
        if row["role"] == role:
            found.setdefault((row["observer"], row["condition"], row["channel"]), {})[row["unit"]] = row[
                "error_percent"
            ]
    alike: dict[tuple[str, ...], list[Cell]] = {}
    for cell, by_unit in found.items():
        if len(by_unit) >= _FEWEST and all(v is not None and np.isfinite(v) for v in by_unit.values()):
            alike.setdefault(tuple(sorted(by_unit)), []).append(cell)
    intervals: dict[Cell, tuple[float, float]] = {}
    for units, cells in alike.items():
        lower, upper = unit_interval(np.array([[found[cell][unit] for cell in cells] for unit in units], dtype=float))
        intervals |= {cell: (float(low), float(high)) for cell, low, high in zip(cells, lower, upper, strict=True)}
    return intervals


def interval_rows(rows: Sequence[Mapping[str, Any]], role: str = "off_nominal") -> list[dict[str, Any]]:
    """Return the same as rows, each with its ``interval`` of lower and upper end."""
    return [
        {"observer": observer, "condition": condition, "channel": channel, "role": role, "interval": list(ends)}
        for (observer, condition, channel), ends in mean_intervals(rows, role).items()
    ]
