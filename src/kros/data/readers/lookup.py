"""What a folder's own list of recordings says about its files, such as a test protocol that was exported from a spreadsheet.

A CSV file with a header, whose columns `file`, `unit`, `condition`, `episode` and `group` count; all others are left alone. A row belongs to the
file that `file` names (its path in the folder, or its name with or without ending), else to the files in whose paths the mapping's expression
finds what the row says. What the expression does not find is taken from the row.
"""

from __future__ import annotations

import csv
import io
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path, PurePosixPath
from typing import TYPE_CHECKING

from ...core.errors import DataError
from .csvfile import opened

if TYPE_CHECKING:
    from .csv_mapping import CsvMapping

KNOWN = ("unit", "condition", "episode", "group")


@dataclass(frozen=True)
class Lookup:
    """Rows of a list of recordings."""

    path: Path  # for messages
    rows: tuple[Mapping[str, str], ...]

    def completed(self, relative: str, found: Mapping[str, str | None]) -> dict[str, str | None]:
        """Return what is known about a file, from its path and from its row."""
        own = [{k: v for k, v in row.items() if k in KNOWN and v} for row in self.rows if self._is_of(row, relative, found)]
        told = [{k: v for k, v in row.items() if not found.get(k)} for row in own]
        if not told or any(row != told[0] for row in told):
            problem = f"{len(told)} different rows" if told else "no row"
            raise DataError(f"Reading {self.path}: there is {problem} for the file {relative!r}; add or correct it, or exclude the file.")
        return {**told[0], **{k: v for k, v in found.items() if v}}

    @staticmethod
    def _is_of(row: Mapping[str, str], relative: str, found: Mapping[str, str | None]) -> bool:
        if row.get("file"):
            name = PurePosixPath(relative).name
            return row["file"] in (relative, name, name.split(".")[0], name.rsplit(".", 1)[0])
        return all(row[k] == v for k, v in found.items() if v and row.get(k))


def read_lookup(source: Path, name: str, mapping: CsvMapping) -> Lookup:
    """Read a list of recordings, delimited by commas, semicolons or tabs, in UTF-8 or in the encoding of the recordings."""
    path = source / name
    with opened(path, mapping.encoding) as file:
        content = b"".join(iter(file.readline, b""))
    try:
        text = content.decode("utf-8-sig")
    except UnicodeDecodeError:
        text = content.decode(mapping.encoding, errors="replace")
    header = text.partition("\n")[0]
    delimiter = max(",;\t", key=header.count)
    rows = [
        {str(k).strip(): str(v or "").strip() for k, v in row.items()} for row in csv.DictReader(io.StringIO(text), delimiter=delimiter)
    ]
    columns = list(rows[0]) if rows else []
    if not set(columns) & set(KNOWN):
        raise DataError(f"Reading {path}: a column {', '.join(KNOWN)} is needed in its header, found {columns}; rename one.")
    return Lookup(path, tuple(rows))
