"""``metrics.json`` with what verdict and sections ask of it; any part but ``study`` may be absent.

Errors of observers are in tables by condition, observer and channel.
"""

from collections.abc import Mapping, Sequence
from dataclasses import field
from functools import cached_property
from operator import itemgetter
from typing import Any

import numpy as np

from ..core import TINY, ByName, Names, frozen, grouped
from ..data import natural_key
from ..design.task import split_name
from .names import in_condition, number, observer_label, readable_unit, words

Rows = Sequence[ByName]
_CELL = ("condition", "observer", "channel")


@frozen
class ErrorCell:
    """Error of an observer in a channel, percent of the largest value; unknown where an estimate diverged."""

    means: Mapping[str, float] = field(default_factory=dict)  # over units, of what all have, by its key in the metrics
    errors: Mapping[str, float] = field(default_factory=dict)  # by unit
    rms: Mapping[str, float] = field(default_factory=dict)  # by unit, in the channel's unit of measure
    interval: Sequence[float] = ()  # 95 % interval of the mean, by a bootstrap over units

    @property
    def worst(self) -> float | None:
        """Largest error of a unit."""
        return max(self.errors.values(), default=None)

    @property
    def worst_rms(self) -> float | None:
        """Largest RMS error of a unit."""
        return max(self.rms.values(), default=None)

    @property
    def mean(self) -> float | None:
        """Mean error over units."""
        return self.means.get("error_percent")

    @property
    def shown(self) -> float | str:
        """Mean error as tables show it."""
        return "diverged" if self.mean is None else self.mean


@frozen
class ErrorTable:
    """Errors of all observers in one condition."""

    condition: str
    cells: Mapping[str, Mapping[str, ErrorCell]]
    measured: Names = ()

    @property
    def hidden(self) -> list[str]:
        """Channels that are estimated and not measured; all where all are measured."""
        known = dict.fromkeys(c for channels in self.cells.values() for c in channels)
        return [c for c in known if c not in self.measured] or list(known)

    def mean(self, observer: str, channels: Sequence[str]) -> float:
        """Return the geometric mean of an observer's mean errors; infinite where one is not known."""
        values = [self.cells[observer].get(c, ErrorCell()).mean for c in channels]
        if not values or None in values:
            return float("inf")
        return float(np.exp(np.mean(np.log(np.maximum(np.array(values, float), TINY)))))


def _cell(rows: Sequence[Any], interval: Sequence[float]) -> ErrorCell:
    """Summarise the units of one observer and channel."""
    if any(r["error_percent"] is None for r in rows):
        return ErrorCell()
    numbers = (key for key, value in rows[0].items() if not isinstance(value, str))
    means = {key: float(np.mean(values)) for key in numbers if None not in (values := [r.get(key) for r in rows])}
    errors, rms = ({r["unit"]: r[key] for r in rows if r.get(key) is not None} for key in ("error_percent", "rms"))
    return ErrorCell(means, errors, rms, interval)


@frozen
class Facts:
    """The metrics of one run."""

    metrics: ByName

    def get(self, name: str) -> Any:
        """Return a part of the metrics, empty where it is absent."""
        return self.metrics.get(name, {})

    @property
    def study(self) -> ByName:
        """What the study is about."""
        return self.metrics["study"]

    @property
    def measured(self) -> Names:
        """Channels that are measured at run time."""
        return tuple(self.study.get("measured", ()))

    @property
    def observers(self) -> Mapping[str, ByName]:
        """What is known of every observer."""
        return self.get("observers")

    @property
    def deployed(self) -> str:
        """Name of the deployed observer; empty where there is none."""
        return self.study.get("deployed") or ""

    @property
    def label(self) -> str:
        """What the deployed observer is called."""
        return observer_label(self.deployed)

    @property
    def entry(self) -> ByName:
        """What is known of the deployed observer."""
        return self.observers.get(self.deployed, {})

    @property
    def model(self) -> str:
        """Model of the deployed observer."""
        return split_name(self.deployed)[0]

    def tables_of(self, rows: Rows, intervals: Rows = ()) -> list[ErrorTable]:
        """Return rows of errors by condition, that of the models first, observer and channel."""
        place, tables = itemgetter(*_CELL), dict[str, dict[str, dict[str, ErrorCell]]]()
        known = {place(row): row["interval"] for row in intervals}
        for (condition, name, channel), units in grouped(rows, place).items():
            cell = _cell(units, known.get((condition, name, channel), ()))
            tables.setdefault(condition, {}).setdefault(name, {})[channel] = cell
        ordered = sorted(tables, key=lambda condition: (condition != self.study["identify_on"], natural_key(condition)))
        return [ErrorTable(condition, tables[condition], self.measured) for condition in ordered]

    @cached_property
    def tables(self) -> list[ErrorTable]:
        """Errors of all observers on the units that took part, a table a condition, that of the models first."""
        rows = [r for r in self.get("evaluation") if r["role"] in ("nominal", "off_nominal")]
        others = [r for r in rows if r["role"] == "off_nominal"] or rows
        return self.tables_of(others, self.get("intervals"))

    @property
    def home(self) -> str:
        """The condition of the errors that come first, as a part of a sentence; nothing where it is the only one."""
        return in_condition(self.table.condition) if len(self.tables) > 1 else ""

    @property
    def table(self) -> ErrorTable:
        """Errors in the condition that the deployed observer was designed for; empty where it was not evaluated."""
        return next((table for table in self.tables[:1] if self.deployed in table.cells), ErrorTable("", {}))

    @property
    def cells(self) -> Mapping[str, ErrorCell]:
        """Errors of the deployed observer in this condition, by channel."""
        return self.table.cells.get(self.deployed, {})

    @property
    def hidden(self) -> list[str]:
        """Channels that the deployed observer estimates and that are not measured."""
        return self.table.hidden

    def unit(self, channel: str) -> str:
        """Return the unit of measure of a channel; nothing where there is none."""
        return readable_unit(self.study.get("channels", {}).get(channel, ""))

    def quantity(self, channel: str, value: float | None) -> str:
        """Return a value of a channel with its unit of measure, if it has one."""
        return f"{number(value)} {self.unit(channel)}".strip()

    def axis(self, channel: str) -> str:
        """Return a channel's name with its unit of measure."""
        return f"{words(channel)} ({self.unit(channel)})" if self.unit(channel) else words(channel)
