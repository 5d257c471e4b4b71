"""Errors of observers by channel and condition: nominal, mean and worst off-nominal unit."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

from ..data.population import natural_key
from ..evaluate import mean_intervals


@dataclass(frozen=True)
class ErrorCell:
    """Error of one observer in one channel, percent of the largest value; None where an estimate diverged or there is no such unit.

    Parameters
    ----------
    nominal : float or None
    mean : float or None
        Over the off-nominal units; of the nominal one where there is no other.
    worst : float or None
    worst_unit : str or None
    diverged : int
        Units whose estimate diverged.
    rms : float or None
        Root mean square error in the channel's own unit of measure, over the units that `mean` is over.
    interval : (float, float) or None
        95 % interval of the mean, by a bootstrap over the off-nominal units; None with fewer than three.
    """

    nominal: float | None
    mean: float | None
    worst: float | None
    worst_unit: str | None
    diverged: int
    rms: float | None = None
    interval: tuple[float, float] | None = None


@dataclass(frozen=True)
class ErrorTable:
    """Errors of all observers in one condition.

    Parameters
    ----------
    condition : str
    channels : tuple of str
    observers : tuple of str
    cells : mapping of observer to mapping of channel to ErrorCell
    ranked : frozenset of str
        Channels in which a smaller number is better; the current of a loaded drive shows the load.
    """

    condition: str
    channels: tuple[str, ...]
    observers: tuple[str, ...]
    cells: Mapping[str, Mapping[str, ErrorCell]]
    ranked: frozenset[str]

    def best(self, channel: str, what: str) -> float | None:
        """Return the smallest ``nominal``, ``mean`` or ``worst`` of a channel; None in a channel that is not ranked."""
        values = [getattr(self.cells[o][channel], what) for o in self.observers if channel in self.cells[o]]
        known = [v for v in values if v is not None]
        return min(known) if known and channel in self.ranked else None


def error_table(rows: Sequence[Mapping[str, Any]], identify_on: str) -> list[ErrorTable]:
    """Summarise evaluation rows, one table a condition, the one that was identified on first.

    Parameters
    ----------
    rows : sequence of mapping
        As in ``metrics.json``: observer, unit, role, condition, channel, rms, error_percent.
    identify_on : str
    """
    conditions = sorted({r["condition"] for r in rows}, key=lambda c: (c != identify_on, natural_key(c)))
    return [_table(c, [r for r in rows if r["condition"] == c], c == identify_on) for c in conditions]


def _table(condition: str, rows: Sequence[Mapping[str, Any]], home: bool) -> ErrorTable:
    channels = tuple(dict.fromkeys(r["channel"] for r in rows))
    grouped: dict[str, dict[str, list[Mapping[str, Any]]]] = {}
    for row in rows:
        grouped.setdefault(row["observer"], {}).setdefault(row["channel"], []).append(row)
    intervals = mean_intervals(rows)
    cells = {
        o: {c: replace(_cell(found), interval=intervals.get((o, condition, c))) for c, found in by_channel.items()}
        for o, by_channel in grouped.items()
    }
    return ErrorTable(condition, channels, tuple(grouped), cells, ranked_channels(channels, condition, home))


def ranked_channels(channels: Sequence[str], condition: str, home: bool) -> frozenset[str]:
    """Return the channels in which a smaller error is better: all but the current of a loaded drive, where models come from another condition."""
    return frozenset(c for c in channels if home or condition != "load" or c != "current")


def _cell(rows: Sequence[Mapping[str, Any]]) -> ErrorCell:
    nominal = next((r["error_percent"] for r in rows if r["role"] == "nominal"), None)
    others = [r for r in rows if r["role"] == "off_nominal"] or [r for r in rows if r["role"] == "nominal"]
    finite = [r for r in others if r["error_percent"] is not None]
    if not others or len(finite) < len(others):
        return ErrorCell(nominal, None, None, None, len(others) - len(finite))
    worst = max(finite, key=lambda r: float(r["error_percent"]))
    mean = sum(r["error_percent"] for r in finite) / len(finite)
    return ErrorCell(nominal, mean, worst["error_percent"], worst["unit"], 0, _mean([r.get("rms") for r in finite]))


def _mean(values: Sequence[float | None]) -> float | None:
    known = [v for v in values if v is not None]
    return sum(known) / len(known) if known and len(known) == len(values) else None
