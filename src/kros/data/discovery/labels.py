"""Tables of several episodes: the columns that say which unit, condition and episode a row belongs to."""

from __future__ import annotations

from collections.abc import Iterable

from ..readers.tables import Table, stretches
from .roles import identifier

_ROLES = {
    "unit": "unit serial number sn id name device machine motor drive rig sample specimen cell dut uut asset maschine "
    "geraet seriennummer nr no",
    "condition": "condition mode zustand",
    "episode": "episode run trial test experiment cycle repetition measurement versuch messung lauf",
}


def label_columns(table: Table) -> dict[str, str]:
    """Return the columns whose names and values, which change now and then in a file, say that they label rows."""
    labels = dict[str, str]()
    for field in table.fields:
        words = set(identifier(f"{field} ").lower().split("_"))
        role = next((role for role, known in _ROLES.items() if words <= set(known.split())), None)
        rows = labelled(table, [field]) if role else []
        if role and 1 < len(rows) < rows[-1].stop / 10:
            labels.setdefault(role, field)
    return labels


def labelled(table: Table, labels: Iterable[str]) -> list[slice]:
    """Return the rows of every episode in a file."""
    return [rows for _, rows in stretches([table.texts(table.fields.index(field)) for field in labels])]
