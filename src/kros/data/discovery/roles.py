"""Columns of a table: units of measure, kinds of quantities, names of channels, and what they are likely to be."""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from enum import Enum

import numpy as np

from ...core import Array, frozen
from ...core.arrays import Texts
from ..measures import ZERO_OF_CELSIUS, Measure, clean_unit, identifier, kind_of, measure, split_header, words_of
from ..readers.parquet import KEYS
from ..readers.tables import Table, stretches

UNKNOWN = "not recognised"
COMMAND = "a command or a voltage, by name and unit"
Samples = Mapping[int, Sequence[Array]]  # of columns by their place, from several episodes
_STATES = ["angle", "position", "velocity", "current", "torque", "force", "pressure", "acceleration"]
_FIRST_MEASURED = (("angle", "position"), ("velocity",), ("pressure",), ("current",), ("force",), ("torque",))

LABELS = {
    "unit": "unit name device machine motor drive rig sample specimen cell dut uut asset maschine geraet",
    "condition": "condition mode zustand",
    "episode": "episode run trial test experiment cycle repetition measurement versuch messung lauf",
}
NUMBERS = {"id", "no", "nr", "number", "serial", "sn", "seriennummer"}  # of a unit, whatever it is, if of nothing else


class ColumnPart(str, Enum):
    """What a column is taken for."""

    TIME = "time"
    MEASURED = "measured"
    STATE = "state"
    INPUT = "input"
    LEFT_OUT = "left out"


@frozen
class TableColumn:
    """A column of the recordings."""

    header: str  # as in the files; the number of the column where there is no header, from 1
    name: str  # of the channel
    unit: str = ""  # unit of measure of the channel, after scaling
    scale: float = 1.0  # to the channel
    offset: float = 0.0  # added after scaling
    recorded: str = ""  # unit of measure of the column itself
    kind: str = ""  # kind of quantity, or nothing
    part: ColumnPart = ColumnPart.LEFT_OUT
    why: str = ""  # what the proposal rests on
    at: int = 0  # place among the columns
    alone: bool = True  # whether its header names it alone

    @property
    def reference(self) -> str | int:
        """How a mapping names the column."""
        return self.header if self.alone else self.at + 1


def describe(table: Table) -> list[TableColumn]:
    """Return the columns that have a header, or all where there is none, without parts."""
    columns = list[TableColumn]()
    for i, (header, stated) in enumerate(zip(table.fields, table.units, strict=True)):
        if not header:
            continue
        stem, written = split_header(header)
        unit = clean_unit(stated) or clean_unit(written)
        name = header if header.isidentifier() and not written else stem
        name = identifier(f"column_{name}" if name.isdigit() else name, [*KEYS, "k", *(c.name for c in columns)])
        known = measure(unit, stem) or Measure(unit, 1.0, 0.0)
        if known.offset:  # a temperature whose zero is not that of K
            known = Measure("degC", known.factor, known.offset - ZERO_OF_CELSIUS)
        about = known.si, known.factor, known.offset, unit, kind_of(stem, unit)
        alone = table.dialect.header and table.fields.count(header) == 1
        columns.append(TableColumn(header, name, *about, at=i, alone=alone))
    return columns


def time_columns(columns: Sequence[TableColumn], samples: Samples) -> list[TableColumn]:
    """Return the columns that may be time, the likeliest first: called so, or increasing evenly, in most samples."""
    rising = [c for c in columns if np.mean([_rises(s) for s in samples[c.at]]) > 0.5]
    called = [c for c in rising if c.kind == "time"]
    other = [c for c in rising if c not in called and not all(map(_counts, samples[c.at]))]
    return called + [c for c in other if all(map(_is_even, samples[c.at]))]


def _rises(column: Array) -> bool:
    steps = np.diff(column)
    return bool(len(steps) and np.isfinite(column).all() and np.mean(steps > 0) > 0.99 and (steps >= 0).all())


def _is_even(column: Array) -> bool:
    steps = np.diff(column)
    return bool(np.mean(np.abs(steps / np.median(steps) - 1) < 0.5) > 0.9)


def _counts(column: Array) -> bool:
    return bool((np.diff(column) == 1).all())


def time_scale(step: float) -> tuple[float, str]:
    """Return the factor from a column of time without a unit to seconds, for steps below one, and the reason."""
    sizes = {"s": 1.0, "ms": 1e-3, "us": 1e-6, "ns": 1e-9}
    name = next((name for name, size in sizes.items() if size * step < 1), "ns")
    return sizes[name], f"no unit is stated, and a step of {step:g} looks like {name}: correct it if it is not"


def propose(columns: Sequence[TableColumn], samples: Samples) -> list[TableColumn]:
    """Return the columns, without that of time, with the part that each is likely to have."""
    proposed = []
    for column in columns:
        spare = _spare(column, samples[column.at])
        part, why = (ColumnPart.LEFT_OUT, spare) if spare else _by_name(column)
        proposed.append(replace(column, part=part, why=why))
    free = [c.kind for c in proposed if c.part is ColumnPart.STATE]
    first = next((kinds for kinds in _FIRST_MEASURED if set(kinds) & set(free)), ())
    measured = [c for c in proposed if c.part is ColumnPart.STATE and c.kind in first]
    return [replace(c, part=ColumnPart.MEASURED) if c in measured else c for c in proposed]


def _spare(column: TableColumn, signals: Sequence[Array]) -> str:
    """Return why a column is not needed, or nothing."""
    if all(np.isnan(s).mean() > 0.1 for s in signals):
        return "mostly empty or text"
    ends = {float(end) for s in signals for end in (np.fmin.reduce(s), np.fmax.reduce(s)) if not np.isnan(end)}
    if len(ends) == 1:
        return f"stays at {ends.pop():g} in the files that were looked at"
    if all(_counts(s) for s in signals):
        return "counts the samples"
    if column.kind == "time" and all(_rises(s) for s in signals):
        return "a second column of time"
    return "by its name" if "spare" in words_of(column.name) else ""


def _by_name(column: TableColumn) -> tuple[ColumnPart, str]:
    """Return the part that the name and the unit of measure of a column speak for, and why."""
    if "input" in words_of(split_header(column.header)[0]) or column.kind == "voltage":
        return ColumnPart.INPUT, COMMAND
    if column.kind in _STATES:
        return ColumnPart.STATE, f"{column.kind}, by name or unit"
    return ColumnPart.LEFT_OUT, UNKNOWN


def label_columns(table: Table) -> Texts:
    """Return the columns whose names and values, which change now and then in a file, say that they label rows."""
    labels = Texts()
    for field in table.fields:
        words = set(identifier(f"{field} ").lower().split("_"))
        named = (role for role, known in LABELS.items() if set() < words - NUMBERS <= set(known.split()))
        role = next(named, "unit" if words & NUMBERS else None)
        rows = [rows for _, rows in stretches([table.texts(table.fields.index(field))])] if role else []
        if role and 1 < len(rows) < rows[-1].stop / 10:
            labels.setdefault(role, field)
    return labels
