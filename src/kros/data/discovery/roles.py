"""What the columns of a table are likely to be: time, measured states, hidden states, inputs, or nothing that is needed."""

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
    "input": "target desired des cmd command commanded setpoint soll sollwert sollposition solldrehzahl sollgeschwindigkeit ref reference "
    "consigne con ctrl control input inputs pwm duty stell stellgroesse stellwert feedforward demand demanded set vorgabe commande u",
    "spare": "filt filtered smooth smoothed index idx sample samples counter count nr no number status flag error err saturation sat mode id "
    "fault fehler zaehler",
    "time": "time zeit t timestamp timestamps date datum uhrzeit clock temps tijd tiempo tempo secs seconds millis datetime zeitstempel",
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
_HIDDEN = ("velocity", "current", "torque", "force", "pressure", "acceleration")
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
    scale, unit = (to_radians(unit) or (1.0, unit)) if kind in ("angle", "velocity", "position") else (1.0, unit)
    return TableColumn(header, name, unit, scale, kind)


def _words_of(name: str) -> list[str]:
    apart = re.sub(r"([a-z])([A-Z])", r"\1 \2", name)
    spelled = identifier(f"{apart} ")
    return [re.sub(r"\d+$", "", word) for word in spelled.lower().split("_") if word]


def _kind_of_name(name: str) -> str:
    kinds = [_OF_WORD[w] for w in _words_of(name) if w in _OF_WORD]
    return next((k for k in kinds if k not in ("input", "spare")), "")


def kind_of(name: str, unit: str = "") -> str:
    """Return the kind of quantity that a channel is, by its unit of measure or its name; nothing where neither says it."""
    return kind_of_unit(unit) or _kind_of_name(name)


def is_commanded(name: str) -> bool:
    """Tell whether a name speaks of a command."""
    return any(_OF_WORD.get(w) == "input" for w in _words_of(name)) or any(
        w.startswith("soll") for w in _words_of(name)
    )


def time_columns(columns: Sequence[TableColumn], samples: Sequence[Array]) -> list[int]:
    """Return the columns that may be time, the likeliest first: called so, or increasing evenly."""
    rising = [i for i in range(len(columns)) if all(_rises(s[i]) for s in samples)]
    called = [i for i in rising if columns[i].kind == "time"]
    even = [
        i
        for i in rising
        if i not in called and all(_is_even(s[i]) for s in samples) and not all(_counts(s[i]) for s in samples)
    ]
    return called + even


def _rises(column: Array) -> bool:
    steps = np.diff(column)
    return bool(len(steps) and np.isfinite(column).all() and np.mean(steps > 0) > 0.99 and (steps >= 0).all())


def _is_even(column: Array) -> bool:
    steps = np.diff(column)
    return bool(np.mean(np.abs(steps - np.median(steps)) < 0.5 * np.median(steps)) > 0.9)


def _counts(column: Array) -> bool:
    return bool((np.diff(column) == 1).all())


def time_scale(unit: str, step: float) -> tuple[float, str]:
    """Return the factor from a column of time to seconds, and what it rests on: its unit of measure, else the size of its steps."""
    known = SECONDS.get(unit.lower())
    if known is not None:
        return known, f"its unit of measure is {unit}"
    for factor, name in ((1.0, "s"), (1e-3, "ms"), (1e-6, "us"), (1e-9, "ns")):
        if SHORTEST_S < factor * step < LONGEST_S:
            return factor, f"a step of {step:g} looks like {name}: correct time_scale if it is not"
    return 1.0, f"a step of {step:g} fits no unit of time: correct time_scale"


def propose(columns: Sequence[TableColumn], samples: Sequence[Array]) -> list[TableColumn]:
    """Return the columns with the part that each is likely to have; time is known already."""
    found: list[TableColumn] = []
    for i, column in enumerate(columns):
        spare = column.part is not ColumnPart.TIME and _spare(i, column, found, samples)
        found.append(replace(column, part=ColumnPart.LEFT_OUT, why=spare) if spare else _by_name(column))
    free = [c for c in found if c.part is ColumnPart.STATE]
    for kinds in _FIRST_MEASURED:
        if any(c.kind in kinds for c in free):
            return [replace(c, part=ColumnPart.MEASURED) if c in free and c.kind in kinds else c for c in found]
    return found


def _spare(i: int, column: TableColumn, before: Sequence[TableColumn], samples: Sequence[Array]) -> str:
    """Return why a column is not needed, or nothing."""
    own = [s[i] for s in samples]
    if all(np.isnan(s).mean() > 0.1 for s in own):
        return "mostly empty or text"
    ends = {float(end) for s in own for end in (np.fmin.reduce(s), np.fmax.reduce(s)) if not np.isnan(end)}
    if len(ends) == 1:
        return f"stays at {ends.pop():g} in the files that were looked at"
    if all(_counts(s) for s in own):
        return "counts the samples"
    if any(_OF_WORD.get(w) == "spare" for w in _words_of(column.name)):
        return "by its name"
    for j, other in enumerate(before):
        if other.part is not ColumnPart.LEFT_OUT and all(np.array_equal(s[i], s[j]) for s in samples):
            return f"the same as {other.header!r}"
    return ""


def _by_name(column: TableColumn) -> TableColumn:
    if column.part is ColumnPart.TIME:
        return column
    if is_commanded(split_header(column.header).name) or column.kind == "voltage":
        return replace(column, part=ColumnPart.INPUT, why="a command or a voltage, by name and unit")
    if column.kind in ("angle", "position", *_HIDDEN):
        return replace(column, part=ColumnPart.STATE, why=f"{column.kind}, by name or unit")
    return replace(
        column, part=ColumnPart.LEFT_OUT, why="a second column of time" if column.kind == "time" else UNKNOWN
    )
