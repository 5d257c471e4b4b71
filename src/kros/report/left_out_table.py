"""Errors of observers on units that were left out of their making: mean over the units with its interval, and the worst unit."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from ..data.population import natural_key
from ..evaluate import unit_interval
from .error_table import ranked_channels

Key = tuple[str, str]
PAPER = "koopman_edmd/mixed"
"""The paper's own observer, which band powers are compared with."""


@dataclass(frozen=True)
class LeftOutCell:
    """Error of one observer in one channel, percent of the largest value; None where some estimate diverged.

    Parameters
    ----------
    mean : float or None
        Over the units.
    low, high : float or None
        95 % interval of the mean, from a bootstrap over units; None for a single unit too.
    worst : float or None
    worst_unit : str or None
    units : mapping of str to float or None
    band_db : float or None
        Power of the error around the gearbox frequency, mean over the units, in dB relative to that of `PAPER` on the same units.
    """

    mean: float | None
    low: float | None
    high: float | None
    worst: float | None
    worst_unit: str | None
    units: Mapping[str, float | None]
    band_db: float | None = None


@dataclass(frozen=True)
class LeftOutTable:
    """Errors of all observers in one condition.

    Parameters
    ----------
    condition : str
    channels : tuple of str
    cells : mapping of observer to mapping of channel to LeftOutCell
    ranked : frozenset of str
        Channels in which a smaller number is better; the current of a loaded drive shows the load.
    """

    condition: str
    channels: tuple[str, ...]
    cells: Mapping[str, Mapping[str, LeftOutCell]]
    ranked: frozenset[str]

    def best(self, channel: str, what: str) -> float | None:
        """Return the smallest ``mean`` or ``worst`` of a channel; None where every observer diverged, or in a channel that is not ranked."""
        if channel not in self.ranked:
            return None
        values = [getattr(cells[channel], what) for cells in self.cells.values() if channel in cells]
        return min((v for v in values if v is not None), default=None)


def left_out_tables(rows: Sequence[Mapping[str, Any]], identify_on: str) -> list[LeftOutTable]:
    """Summarise the rows of ``metrics.json``'s ``left_out``, one table a condition, the one that was identified on first.

    Parameters
    ----------
    rows : sequence of mapping
        observer, unit, condition, channel, error_percent and, where there is a gearbox, gearbox_band_power.
    identify_on : str
    """
    conditions = sorted({r["condition"] for r in rows}, key=lambda c: (c != identify_on, natural_key(c)))
    return [_table(c, [r for r in rows if r["condition"] == c], c == identify_on) for c in conditions]


def _table(condition: str, rows: Sequence[Mapping[str, Any]], home: bool) -> LeftOutTable:
    grouped: dict[tuple[str, str], list[Mapping[str, Any]]] = {}
    for row in rows:
        grouped.setdefault((row["observer"], row["channel"]), []).append(row)
    means = _intervals({key: [r["error_percent"] for r in found] for key, found in grouped.items()})
    cells: dict[str, dict[str, LeftOutCell]] = {}
    for (observer, channel), found in grouped.items():
        band_db = _band_db(found, grouped.get((PAPER, channel), []))
        cells.setdefault(observer, {})[channel] = _cell(found, means.get((observer, channel)), band_db)
    channels = tuple(dict.fromkeys(channel for _, channel in grouped))
    return LeftOutTable(condition, channels, cells, ranked_channels(channels, condition, home))


def _intervals(errors: Mapping[Key, Sequence[float | None]]) -> dict[Key, tuple[float, float]]:
    """Return the intervals of all means over several units, cells with as many units together: they share the draws."""
    finite = {key: values for key, values in errors.items() if all(v is not None and np.isfinite(v) for v in values)}
    found: dict[Key, tuple[float, float]] = {}
    for count in {len(values) for values in finite.values()} - {1}:
        keys = [key for key, values in finite.items() if len(values) == count]
        low, high = unit_interval(np.array([finite[key] for key in keys], float).T)
        found |= {key: (float(a), float(b)) for key, a, b in zip(keys, low, high, strict=True)}
    return found


def _cell(rows: Sequence[Mapping[str, Any]], interval: tuple[float, float] | None, band_db: float | None) -> LeftOutCell:
    units = {r["unit"]: r["error_percent"] for r in rows}
    known = {unit: float(error) for unit, error in units.items() if error is not None and np.isfinite(error)}
    if len(known) < len(units):
        return LeftOutCell(None, None, None, None, None, units, band_db)
    worst = max(known, key=lambda u: known[u])
    low, high = interval if interval is not None else (None, None)
    return LeftOutCell(float(np.mean(list(known.values()))), low, high, known[worst], worst, units, band_db)


def _band_db(rows: Sequence[Mapping[str, Any]], papers: Sequence[Mapping[str, Any]]) -> float | None:
    """Return the ratio of mean powers around the gearbox frequency over the units that both have; None where one is unknown or infinite."""
    own, theirs = ({r["unit"]: r.get("gearbox_band_power") for r in found} for found in (rows, papers))
    shared = [unit for unit in own if unit in theirs]
    pairs = np.array([[own[unit], theirs[unit]] for unit in shared], float)
    if not shared or not np.isfinite(pairs).all() or not pairs.sum(axis=0).all():
        return None
    powers = pairs.mean(axis=0)
    return float(10 * np.log10(powers[0] / powers[1]))
