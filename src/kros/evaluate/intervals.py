"""Mean errors over units with their confidence intervals, for all observers at once: the same resampled units for every one."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from .bootstrap import unit_interval

Cell = tuple[str, str, str]
_FEWEST = 3  # units: of two there are three resamples


def mean_intervals(rows: Sequence[Mapping[str, Any]], role: str = "off_nominal") -> dict[Cell, tuple[float, float]]:
    """Return the 95 % interval of the mean error over units, by observer, condition and channel.

    Parameters
    ----------
    rows : sequence of mapping
        As ``evaluation`` in ``metrics.json``: observer, unit, role, condition, channel, error_percent.
    role : str
        Of the units that count.

    Returns
    -------
    dict
        Nothing where an estimate diverged or there are fewer than three units.
    """
    found: dict[Cell, dict[str, float | None]] = {}
    for row in rows:
        if row["role"] == role:
            found.setdefault((row["observer"], row["condition"], row["channel"]), {})[row["unit"]] = row["error_percent"]
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
