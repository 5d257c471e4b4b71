"""What the columns of a table are likely to be: time, measured states, hidden states, inputs, or not needed."""

from __future__ import annotations

import re
from collections.abc import Collection, Sequence
from dataclasses import dataclass, replace
from enum import Enum

import numpy as np
import numpy.typing as npt

from ..alerts import LONGEST_S, SHORTEST_S
from .measures import SECONDS, clean_unit, identifier, kind_of_unit, split_header, to_radians

Array = npt.NDArray[np.float64]


class ColumnPart(str, Enum):
    """What a column is taken for."""

    TIME = "time"
    MEASURED = "measured"
    STATE = "state"
    INPUT = "input"
    LEFT_OUT = "left out"


WORDS = {
    "input": "target desired des cmd command commanded setpoint soll sollwert sollposition solldrehzahl ref reference "
    "sollgeschwindigkeit consigne con ctrl control input inputs pwm duty stell stellgroesse stellwert feedforward "
    "demand demanded set vorgabe commande u",
    "spare": "filt filtered smooth smoothed index idx sample samples counter count nr no number status flag error err "
    "saturation sat mode id fault fehler zaehler",
    "time": "time zeit t timestamp timestamps date datum uhrzeit clock temps tijd tiempo tempo secs seconds millis "
    "datetime zeitstempel",
    "angle": "angle winkel theta phi alpha beta gamma q encoder enc rotation drehwinkel angolo",
    "position": "pos position lage weg stroke hub displacement x y z istposition posizione travel",
    "velocity": "vel velocity speed drehzahl geschwindigkeit omega rpm rate v w dq qd vitesse istdrehzahl velocita",
    "acceleration": "acc accel acceleration beschleunigung",
    "current": "current strom i iq courant amp amps corrente motorstrom",
    "torque": "torque tau moment drehmoment couple coppia",
    "force": "force kraft f effort forza",
    "pressure": "pressure druck p pression oeldruck",
    "temperature": "temp temperature temperatur",
    "voltage": "volt voltage spannung tension",
}
_OF_WORD = {word: kind for kind, words in WORDS.items() for word in words.split()}
UNKNOWN = "not recognised"
_STATES = ("angle", "position", "velocity", "current", "torque", "force", "pressure", "acceleration")
_FIRST_MEASURED = (("angle", "position"), ("velocity",), ("pressure",), ("current",), ("force",), ("torque",))


@dataclass(frozen=True)
class TableColumn:
    """A column of the recordings."""

    header: str  # as in the files; the number of the column where there is no header
    name: str  # of the channel
    unit: str = ""  # unit of measure of the channel, after scaling
    scale: float = 1.0  # to the channel
    kind: str = ""  # kind of quantity, or nothing
    part: ColumnPart = ColumnPart.LEFT_OUT
    why: str = ""  # what the proposal rests on
    number: int | None = None  # of the column, from 1, where its header does not name it alone

    @property
    def reference(self) -> str | int:
        """How a mapping names the column."""
        return self.header if self.number is None else self.number


def describe(header: str, unit: str, taken: Collection[str]) -> TableColumn:
    """Return a column by its header and the unit in a row of units, without a part."""
    split = split_header(header)
    unit = clean_unit(unit) or clean_unit(split.unit)
    name = split.name if split.unit or not header.isidentifier() else header
    name = identifier(f"column_{name}" if name.isdigit() else name, list(taken))
    kind = kind_of(split.name, unit)
    radians = to_radians(unit) if kind in ("angle", "velocity", "position") else None
    scale, unit = radians or (1.0, unit)
    return TableColumn(header, name, unit, scale, kind)


def _kinds_of(name: str) -> list[str]:
    """Return the kinds that the words of a name stand for, with nothing for words that are not known."""
    apart = re.sub(r"([a-z])([A-Z])", r"\1 \2", name)
    words = identifier(f"{apart} ").lower().split("_")
    return [_OF_WORD.get(re.sub(r"\d+$", "", word), "input" if word.startswith("soll") else "") for word in words]


def kind_of(name: str, unit: str = "") -> str:
    """Return the kind of quantity that a channel is, by its unit of measure or its name, or nothing."""
    quantities = (kind for kind in _kinds_of(name) if kind not in ("", "input", "spare"))
    return kind_of_unit(unit) or next(quantities, "")


def is_commanded(name: str) -> bool:
    """Tell whether a name speaks of a command."""
    return "input" in _kinds_of(name)


def time_columns(columns: Sequence[TableColumn], samples: Sequence[Array]) -> list[int]:
    """Return the columns that may be time, the likeliest first: called so, or increasing evenly."""
    rising = [i for i in range(len(columns)) if all(_rises(s[i]) for s in samples)]
    called = [i for i in rising if columns[i].kind == "time"]
    even = [i for i in rising if all(_is_even(s[i]) for s in samples) and not all(_counts(s[i]) for s in samples)]
    return called + [i for i in even if i not in called]


def _rises(column: Array) -> bool:
    steps = np.diff(column)
    return bool(len(steps) and np.isfinite(column).all() and np.mean(steps > 0) > 0.99 and (steps >= 0).all())


def _is_even(column: Array) -> bool:
    steps = np.diff(column)
    return bool(np.mean(np.abs(steps - np.median(steps)) < 0.5 * np.median(steps)) > 0.9)


def _counts(column: Array) -> bool:
    return bool((np.diff(column) == 1).all())


def time_scale(unit: str, step: float) -> tuple[float, str]:
    """Return the factor from a column of time to seconds by its unit, else the size of its steps, and the reason."""
    if unit.lower() in SECONDS:
        return SECONDS[unit.lower()], f"its unit of measure is {unit}"
    for name in ("s", "ms", "us", "ns"):
        if SHORTEST_S < SECONDS[name] * step < LONGEST_S:
            return SECONDS[name], f"a step of {step:g} looks like {name}: correct time_scale if it is not"
    return 1.0, f"a step of {step:g} fits no unit of time: correct time_scale"


def propose(columns: Sequence[TableColumn], samples: Sequence[Array]) -> list[TableColumn]:
    """Return the columns with the part that each is likely to have; time is known already."""
    proposed: list[TableColumn] = []
    for i, column in enumerate(columns):
        spare = _spare(i, column, proposed, samples) if column.part is not ColumnPart.TIME else ""
        proposed.append(replace(column, part=ColumnPart.LEFT_OUT, why=spare) if spare else _by_name(column))
    free = [c.kind for c in proposed if c.part is ColumnPart.STATE]
    first = next((kinds for kinds in _FIRST_MEASURED if set(kinds) & set(free)), ())
    measured = [c for c in proposed if c.part is ColumnPart.STATE and c.kind in first]
    return [replace(c, part=ColumnPart.MEASURED) if c in measured else c for c in proposed]


def _spare(i: int, column: TableColumn, before: Sequence[TableColumn], samples: Sequence[Array]) -> str:
    """Return why a column is not needed, or nothing."""
    signals = [s[i] for s in samples]
    if all(np.isnan(s).mean() > 0.1 for s in signals):
        return "mostly empty or text"
    ends = {float(end) for s in signals for end in (np.fmin.reduce(s), np.fmax.reduce(s)) if not np.isnan(end)}
    if len(ends) == 1:
        return f"stays at {ends.pop():g} in the files that were looked at"
    if all(_counts(s) for s in signals):
        return "counts the samples"
    if "spare" in _kinds_of(column.name):
        return "by its name"
    for j, other in enumerate(before):
        if other.part is not ColumnPart.LEFT_OUT and all(np.array_equal(s[i], s[j]) for s in samples):
            return f"the same as {other.header!r}"
    return ""


def _by_name(column: TableColumn) -> TableColumn:
    """Return a column with the part that its name and unit of measure speak for."""
    if column.part is ColumnPart.TIME:
        return column
    if is_commanded(split_header(column.header).name) or column.kind == "voltage":
        return replace(column, part=ColumnPart.INPUT, why="a command or a voltage, by name and unit")
    if column.kind in _STATES:
        return replace(column, part=ColumnPart.STATE, why=f"{column.kind}, by name or unit")
    why = "a second column of time" if column.kind == "time" else UNKNOWN
    return replace(column, part=ColumnPart.LEFT_OUT, why=why)
