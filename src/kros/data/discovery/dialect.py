"""How a text file of numbers is written: encoding, delimiter, decimal point, header, rows of units and the rows before them."""

from __future__ import annotations

import codecs
import csv
import re
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from ...core.errors import DataError
from ..readers.csvfile import ABSENT, Dialect, opened
from ..readers.timestamps import CLOCK, DATES, pattern
from .measures import is_unit_row

HEAD_BYTES, ROWS, SPREAD = 1 << 18, 60, 200
MARKS = ((";", ","), (";", "."), ("\t", ","), ("\t", "."), (",", "."), ("|", "."), ("|", ","), (" ", "."), (" ", ","))
_NUMBER = re.compile(r"^[+-]?(?:\d+(?:[.,]\d*)?|[.,]\d+)(?:[eEdD][+-]?\d+)?$")
_NO_NUMBER = {
    "",
    "nan",
    "+nan",
    "-nan",
    "null",
    "none",
    "na",
    "n/a",
    "inf",
    "-inf",
    "+inf",
    "#n/a",
    *(a.lower() for a in ABSENT),
}
_TIME = re.compile(
    rf"^\s*(?:(?:{'|'.join(re.sub(r'[?]P<[a-z]+>', '?:', d) for d in DATES.values())})[T ]\s*)?{re.sub(r'[?]P<[a-z]+>', '?:', CLOCK)}\s*$"
)


@dataclass(frozen=True)
class TableHead:
    """What the first lines of a file say."""

    dialect: Dialect
    fields: tuple[str, ...]  # header; numbers of the columns as text where there is none
    units: tuple[str, ...]  # cells of the row of units of measure, empty where there is none
    rows: tuple[tuple[str, ...], ...]  # cells of the first rows of numbers

    def cells(self, column: int) -> list[str]:
        """Return the first cells of a column."""
        return [row[column].strip() if column < len(row) else "" for row in self.rows]

    def is_numeric(self, column: int) -> bool:
        """Tell whether a column holds numbers."""
        cells = self.cells(column)
        decimal = self.dialect.decimal
        return any(_is_number(c, decimal) for c in cells) and all(
            _is_number(c, decimal) or c.lower() in _NO_NUMBER for c in cells
        )

    def timestamp(self, column: int) -> str | None:
        """Return the order of the date where a column holds timestamps, or None."""
        cells = [c for c in self.cells(column) if c]
        fitting = [order for order in DATES if cells and all(re.match(pattern(order), c) for c in cells)]
        return fitting[0] if fitting else None


def look_at(path: Path) -> TableHead:
    """Return how a text file is written."""
    content = _head(path)
    encoding = encoding_of(content)
    lines = content.decode(encoding, errors="replace").removeprefix("\ufeff").splitlines()
    if len(content) >= HEAD_BYTES:
        lines = lines[:-1]
    if encoding == "utf-8-sig":
        encoding = "utf-8"
    best: tuple[tuple[int, int], str, str, list[list[str]]] | None = None
    for delimiter, decimal in MARKS:
        rows = _rows(lines, delimiter)
        score = _score(rows, decimal)
        if best is None or score > best[0]:
            best = score, delimiter, decimal, rows
    if best is None or best[0][0] < 2:
        raise DataError(
            f"Reading {path}: no rows of numbers were found in its first {len(lines)} lines; is it a recording?"
        )
    _, delimiter, decimal, rows = best
    return _described(rows, Dialect(delimiter, decimal=decimal, encoding=encoding))


def encoding_of(content: bytes) -> str:
    """Return the encoding that the first bytes of a text speak for."""
    if content.startswith(codecs.BOM_UTF8):
        return "utf-8-sig"
    if content.startswith((codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE)):
        return "utf-16"
    try:
        codecs.getincrementaldecoder("utf-8")().decode(content)
        return "utf-8"
    except UnicodeDecodeError:
        pass
    try:
        content.decode("cp1252")
        return "cp1252"
    except UnicodeDecodeError:
        return "latin-1"


def _head(path: Path) -> bytes:
    with opened(path) as file:
        content = b""
        while len(content) < HEAD_BYTES and (more := file.read(HEAD_BYTES - len(content))):
            content += more
    return content


def _rows(lines: Sequence[str], delimiter: str) -> list[list[str]]:
    rows = []
    first, rest = lines[: 20 + ROWS], lines[20 + ROWS :]
    for line in [
        *first,
        *rest[:: max(1, len(rest) // SPREAD)],
    ]:  # machines rest at first, and zeros have no decimal point
        try:
            rows.append([c.strip() for c in next(csv.reader([line], delimiter=delimiter, skipinitialspace=True), [])])
        except csv.Error:
            rows.append([])
    return rows


def _is_number(cell: str, decimal: str) -> bool:
    return bool(_NUMBER.match(cell)) and ("," not in cell if decimal == "." else "." not in cell)


def _is_data(row: Sequence[str], decimal: str) -> bool:
    """Tell whether a row holds numbers: no cell of more than a tenth is text, but for a note or a date."""
    cells = [c for c in row if c.lower() not in _NO_NUMBER]
    numbers = sum(_is_number(c, decimal) or bool(_TIME.match(c)) for c in cells)
    return len(row) > 1 and numbers >= 1 and 2 * numbers >= len(cells)


def _score(rows: Sequence[Sequence[str]], decimal: str) -> tuple[int, int]:
    """Return how many rows of equal width hold numbers, and how many numbers with a decimal point they hold."""
    data = [r for r in rows if _is_data(r, decimal)]
    if not data:
        return 0, 0
    widths = [len(r) for r in data]
    width = max(set(widths), key=widths.count)
    same = [r for r in data if len(r) == width]
    return len(same), sum(_is_number(c, decimal) and decimal in c for r in same for c in r) + sum(
        _is_number(c, decimal) for r in same for c in r
    )


def _described(rows: list[list[str]], dialect: Dialect) -> TableHead:
    data = [i for i, r in enumerate(rows) if _is_data(r, dialect.decimal)]
    widths = [len(rows[i]) for i in data]
    width = max(set(widths), key=widths.count)
    first = next(i for i in data if len(rows[i]) == width and (i + 1 >= len(rows) or i + 1 in data))
    cells = tuple(tuple(rows[i]) for i in data if i >= first)[:ROWS]
    above = [
        i
        for i in range(first)
        if 2 * sum(bool(c) for c in rows[i]) >= sum(bool(c) for c in cells[0]) and abs(len(rows[i]) - width) <= 1
    ]
    if not above:
        return TableHead(
            replace(dialect, header=False, skip_rows=first),
            tuple(str(i + 1) for i in range(width)),
            ("",) * width,
            cells,
        )
    header, units = above[-1], [""] * width
    unit_rows = [i for i in above[1:] if is_unit_row(rows[i])]
    if unit_rows:
        header = above[above.index(unit_rows[0]) - 1]
        units = rows[unit_rows[0]]
    fields = tuple((rows[header] + [""] * width)[:width])
    return TableHead(
        replace(dialect, skip_rows=header, unit_rows=first - header - 1),
        fields,
        tuple((units + [""] * width)[:width]),
        cells,
    )
