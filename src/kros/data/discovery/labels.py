"""Tables of several episodes: the columns that say which unit, condition and episode a row belongs to."""

from __future__ import annotations

from collections.abc import Iterable
from itertools import accumulate, groupby
from pathlib import Path

from ..readers.tables import read_labels
from .dialect import TableHead
from .roles import identifier

_ROLES = {
    "unit": "unit serial number sn id name device machine motor drive rig sample specimen cell dut uut asset maschine "
    "geraet seriennummer nr no",
    "condition": "condition mode zustand",
    "episode": "episode run trial test experiment cycle repetition measurement versuch messung lauf",
}


def label_columns(path: Path, head: TableHead) -> dict[str, str]:
    """Return the columns whose names and values, which change now and then in a file, say that they label rows."""
    labels = dict[str, str]()
    for field in head.fields:
        words = set(identifier(f"{field} ").lower().split("_"))
        role = next((role for role, known in _ROLES.items() if words <= set(known.split())), None)
        rows = stretches(path, head, [field]) if role else []
        if role and 1 < len(rows) < rows[-1].stop / 10:
            labels.setdefault(role, field)
    return labels


def stretches(path: Path, head: TableHead, labels: Iterable[str]) -> list[slice]:
    """Return the rows of every episode in a file."""
    columns = [read_labels(path, head.fields, head.fields.index(field), head.dialect) for field in labels]
    counts = [len(list(rows)) for _, rows in groupby(zip(*columns, strict=True))]
    return [slice(end - count, end) for end, count in zip(accumulate(counts), counts, strict=True)]
