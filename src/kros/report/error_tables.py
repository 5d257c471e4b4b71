"""Errors of observers by channel and condition, from the rows of ``metrics.json``."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import field
from typing import Any

import numpy as np

from ..core import ByName, Names, frozen
from ..data import natural_key

Rows = Sequence[ByName]


@frozen
class ErrorCell:
    """Error of an observer in a channel, percent of the largest value; None where an estimate diverged."""

    mean: float | None = None
    worst: float | None = None
    worst_unit: str | None = None
    interval: Sequence[float] | None = None  # 95 % interval of the mean, by a bootstrap over units
    diverged: int = 0  # units whose estimate diverged
    worst_rms: float | None = None
    means: Mapping[str, float] = field(default_factory=dict)  # over units, of what all have, by its key in the metrics


@frozen
class ErrorTable:
    """Errors of all observers in one condition."""

    condition: str
    channels: Names
    cells: Mapping[str, Mapping[str, ErrorCell]]

    def hidden(self, measured: Sequence[str], observer: str | None = None) -> list[str]:
        """Return the channels that are not measured and that an observer estimates, or any does; else all of them."""
        known = [c for c in self.channels if observer is None or c in self.cells[observer]]
        return [c for c in known if c not in measured] or known

    def mean(self, observer: str, channels: Sequence[str]) -> float:
        """Return the geometric mean of an observer's mean errors; infinite where one is not known."""
        values = [self.cells[observer].get(c, ErrorCell()).mean for c in channels]
        if not values or None in values:
            return float("inf")
        return float(np.exp(np.mean(np.log(np.maximum(np.array(values, float), np.finfo(float).tiny)))))


def error_tables(metrics: ByName) -> list[ErrorTable]:
    """Return a table a condition of the units that took part, the condition that was identified on first."""
    rows = [r for r in metrics.get("evaluation", []) if r["role"] in ("nominal", "off_nominal")]
    others = [r for r in rows if r["role"] == "off_nominal"] or rows
    intervals = {
        (r["observer"], r["condition"], r["channel"]): tuple(r["interval"]) for r in metrics.get("intervals", [])
    }
    return tables_of(others, metrics["study"]["identify_on"], intervals)


def tables_of(rows: Rows, identify_on: str, intervals: Mapping[Any, Any] | None = None) -> list[ErrorTable]:
    """Return rows of errors by condition, observer and channel."""
    tables, known = [], intervals or {}
    for condition in sorted({r["condition"] for r in rows}, key=lambda c: (c != identify_on, natural_key(c))):
        grouped = dict[str, dict[str, list[ByName]]]()
        for row in (r for r in rows if r["condition"] == condition):
            grouped.setdefault(row["observer"], {}).setdefault(row["channel"], []).append(row)
        cells = {
            name: {c: _cell(units, known.get((name, condition, c))) for c, units in channels.items()}
            for name, channels in grouped.items()
        }
        names = tuple(dict.fromkeys(c for channels in grouped.values() for c in channels))
        tables.append(ErrorTable(condition, names, cells))
    return tables


def _cell(rows: Sequence[Any], interval: Sequence[float] | None) -> ErrorCell:
    """Summarise the units of one observer and channel."""
    lost = len({r["unit"] for r in rows if r["error_percent"] is None})
    if lost:
        return ErrorCell(diverged=lost)
    worst = max(rows, key=lambda r: float(r["error_percent"]))
    numbers = (key for key, value in rows[0].items() if not isinstance(value, str))
    known = {key: values for key in numbers if None not in (values := [r.get(key) for r in rows])}
    means = {key: float(np.mean(values)) for key, values in known.items()}
    return ErrorCell(
        means["error_percent"],
        float(worst["error_percent"]),
        worst["unit"],
        interval,
        worst_rms=max(known.get("rms", ()), default=None),
        means=means,
    )
