"""Errors of observers by channel and condition, of units that took part in their design and of units that were left out of it."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from ..data.population import natural_key
from ..evaluate import unit_interval
from ..evaluate.intervals import mean_intervals

Rows = Sequence[Mapping[str, Any]]
PAPER = "koopman_edmd/mixed"
"""The paper's own observer, which band powers are compared with."""


@dataclass(frozen=True)
class ErrorCell:
    """Error of an observer in a channel, percent of the largest value; None where an estimate diverged."""

    mean: float | None = None
    worst: float | None = None
    worst_unit: str | None = None
    interval: tuple[float, float] | None = None  # 95 % interval of the mean, by a bootstrap over units
    nominal: float | None = None  # of the nominal unit
    diverged: int = 0  # units whose estimate diverged
    rms: float | None = None
    band_db: float | None = None


@dataclass(frozen=True)
class ErrorTable:
    """Errors of all observers in one condition."""

    condition: str
    channels: tuple[str, ...]
    cells: Mapping[str, Mapping[str, ErrorCell]]
    ranked: frozenset[str]  # channels in which a smaller number is better

    def hidden(self, measured: Sequence[str], observer: str | None = None) -> list[str]:
        """Return the channels that are not measured and that an observer estimates, or any does; all of them where everything is measured."""
        known = [c for c in self.channels if observer is None or c in self.cells[observer]]
        return [c for c in known if c not in measured] or known

    def best(self, channel: str, what: str) -> float | None:
        """Return the smallest ``nominal``, ``mean`` or ``worst`` of a channel; None where every observer diverged, or in a channel that is not ranked."""
        if channel not in self.ranked:
            return None
        values = [getattr(cells[channel], what) for cells in self.cells.values() if channel in cells]
        return min((v for v in values if v is not None), default=None)


def error_table(rows: Rows, identify_on: str) -> list[ErrorTable]:
    """Summarise the rows of ``evaluation`` in ``metrics.json``, one table a condition, the one that was identified on first."""
    intervals = mean_intervals(rows)

    def cell(observer: str, condition: str, channel: str, found: Rows, _: Rows) -> ErrorCell:
        return _cell(found, intervals.get((observer, condition, channel)))

    return _tables(rows, identify_on, cell)


def home_table(metrics: Mapping[str, Any]) -> ErrorTable | None:
    """Return the errors in the condition that was identified on, where the deployed observer was evaluated there."""
    tables = error_table(metrics.get("evaluation", []), metrics["study"]["identify_on"])
    return tables[0] if tables and metrics["study"].get("deployed") in tables[0].cells else None


def left_out_tables(rows: Rows, identify_on: str) -> list[ErrorTable]:
    """Summarise the rows of ``left_out`` in ``metrics.json``, one table a condition, the one that was identified on first."""

    def cell(observer: str, condition: str, channel: str, found: Rows, papers: Rows) -> ErrorCell:
        return _left_out_cell(found, _band_db(found, papers))

    return _tables(rows, identify_on, cell)


def _tables(rows: Rows, identify_on: str, cell: Callable[[str, str, str, Rows, Rows], ErrorCell]) -> list[ErrorTable]:
    tables = []
    for condition in sorted({r["condition"] for r in rows}, key=lambda c: (c != identify_on, natural_key(c))):
        grouped: dict[str, dict[str, list[Mapping[str, Any]]]] = {}
        for row in rows:
            if row["condition"] == condition:
                grouped.setdefault(row["observer"], {}).setdefault(row["channel"], []).append(row)
        papers = grouped.get(PAPER, {})
        cells = {
            o: {c: cell(o, condition, c, found, papers.get(c, [])) for c, found in own.items()}
            for o, own in grouped.items()
        }
        channels = tuple(dict.fromkeys(r["channel"] for r in rows if r["condition"] == condition))
        ranked = frozenset(c for c in channels if condition == identify_on or condition != "load" or c != "current")
        tables.append(ErrorTable(condition, channels, cells, ranked))
    return tables


def _cell(rows: Rows, interval: tuple[float, float] | None) -> ErrorCell:
    nominal = next((r["error_percent"] for r in rows if r["role"] == "nominal"), None)
    others = [r for r in rows if r["role"] == "off_nominal"] or [r for r in rows if r["role"] == "nominal"]
    finite = [r for r in others if r["error_percent"] is not None]
    if not others or len(finite) < len(others):
        return ErrorCell(nominal=nominal, diverged=len(others) - len(finite))
    worst = max(finite, key=lambda r: float(r["error_percent"]))
    rms = [r.get("rms") for r in finite]
    known = [v for v in rms if v is not None]
    return ErrorCell(
        sum(r["error_percent"] for r in finite) / len(finite),
        worst["error_percent"],
        worst["unit"],
        interval,
        nominal,
        rms=sum(known) / len(known) if len(known) == len(rms) else None,
    )


def _left_out_cell(rows: Rows, band_db: float | None) -> ErrorCell:
    units = {r["unit"]: r["error_percent"] for r in rows}
    known = {unit: float(error) for unit, error in units.items() if error is not None and np.isfinite(error)}
    if len(known) < len(units):
        return ErrorCell(band_db=band_db, diverged=len(units) - len(known))
    worst, values = max(known, key=lambda u: known[u]), list(known.values())
    interval = None
    if len(values) > 1:
        low, high = unit_interval(values)
        interval = (float(low), float(high))
    rms = [float(v) for r in rows if (v := r.get("rms")) is not None]
    mean_rms = float(np.mean(rms)) if len(rms) == len(rows) else None
    return ErrorCell(float(np.mean(values)), known[worst], worst, interval, rms=mean_rms, band_db=band_db)


def _band_db(rows: Rows, papers: Rows) -> float | None:
    """Return the ratio of mean powers around the gearbox frequency over the units that both have; None where one is unknown or infinite."""
    own, theirs = ({r["unit"]: r.get("gearbox_band_power") for r in found} for found in (rows, papers))
    shared = [unit for unit in own if unit in theirs]
    pairs = np.array([[own[unit], theirs[unit]] for unit in shared], float)
    if not shared or not np.isfinite(pairs).all() or not pairs.sum(axis=0).all():
        return None
    powers = pairs.mean(axis=0)
    return float(10 * np.log10(powers[0] / powers[1]))
