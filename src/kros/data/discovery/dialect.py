"""How a text file of numbers is written: encoding, delimiter, decimal point, header and rows of units."""

import codecs
import csv
import re
from collections import Counter
from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path

import numpy as np

from ...core import DataError, Names, frozen
from ..measures import is_unit_row
from ..readers.formats import is_binary, texts_of
from ..readers.tables import ABSENT, ORDERS, Dialect, Table, cells_of, head_of, lines_of, microseconds
from .examine import RULE

MARKS = [tuple(marks) for marks in (";,", ";.", "\t,", "\t.", ",.", "|.", "|,", " .", " ,")]  # delimiter, decimal point
_NUMBER = re.compile(r"^[+-]?(?:\d+(?:[.,]\d*)?|[.,]\d+)(?:[eEdD][+-]?\d+)?$")
_CLOCK = re.compile(r"^(?:\d+[-./]\d+[-./]\d+[T ]\s*)?\d{1,2}:\d{2}:\d{2}(?:Z|\b)")
_ABSENT_WORDS = "nan +nan -nan null none na n/a inf -inf +inf #n/a"
_NO_NUMBER = {"", *_ABSENT_WORDS.split(), *(a.lower() for a in ABSENT)}


@frozen
class TableHead(Table):
    """A table with the cells of its first rows of numbers."""

    rows: tuple[Names, ...]

    def cells(self, column: int) -> list[str]:
        """Return the first cells of a column."""
        return [row[column].strip() if column < len(row) else "" for row in self.rows]

    def is_numeric(self, column: int) -> bool:
        """Tell whether a column holds numbers."""
        cells = [c for c in self.cells(column) if c.lower() not in _NO_NUMBER]
        return bool(cells) and all(_is_number(c, self.dialect.decimal) for c in cells)

    def timestamp(self, column: int) -> str | None:
        """Return the order of the date where a column holds timestamps, or None."""
        cells = [c for c in self.cells(column) if c]
        if not cells or not all(map(_CLOCK.match, cells)):
            return None
        import pyarrow as pa

        stamps = pa.array(cells)
        return next((order for order in ORDERS if np.isfinite(microseconds(stamps, order)).all()), None)


def look_at(path: Path) -> TableHead:
    """Return how a file is written; a text file by the reading with most rows of numbers of equal width."""
    if is_binary(path):
        table = Table.open(path, Dialect())
        cells = zip(*(texts_of(path, name)[: RULE.rows] for name in table.fields), strict=True)
        return TableHead(**vars(table), rows=tuple(cells))
    content = head_of(path)
    encoding = encoding_of(content)
    lines = lines_of(content, encoding, path)
    readings = [(_rows(lines, delimiter), delimiter, decimal) for delimiter, decimal in MARKS]
    rows, delimiter, decimal = max(readings, key=lambda reading: _score(reading[0], reading[2]))
    if _score(rows, decimal)[0] < 2:
        raise DataError(f"Reading {path}: no rows of numbers were found in its first {len(lines)} lines; check it.")
    return _described(path, rows, Dialect(delimiter=delimiter, decimal=decimal, encoding=encoding))


def encoding_of(content: bytes) -> str:
    """Return the encoding that the first bytes of a text speak for."""
    if content.startswith((codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE)):
        return "utf-16"
    for name in ("utf-8", "cp1252"):
        with suppress(UnicodeDecodeError):
            codecs.getincrementaldecoder(name)().decode(content)  # the last character may be cut
            return name
    return "latin-1"


def _rows(lines: Sequence[str], delimiter: str) -> list[list[str]]:
    """Cut the first lines, and some of the others, into cells."""
    first, rest = lines[: RULE.above + RULE.rows], lines[RULE.above + RULE.rows :]
    rows = []
    for line in (*first, *rest[:: max(1, len(rest) // RULE.spread)]):
        try:
            rows.append(cells_of(line, delimiter))
        except csv.Error:
            rows.append([])
    return rows


def _is_number(cell: str, decimal: str) -> bool:
    return bool(_NUMBER.match(cell)) and ("," if decimal == "." else ".") not in cell


def _is_data(row: Sequence[str], decimal: str) -> bool:
    """Tell whether a row holds numbers: at most half of its cells are text that is no time."""
    cells = [c for c in row if c.lower() not in _NO_NUMBER]
    numbers = sum(_is_number(c, decimal) or bool(_CLOCK.match(c)) for c in cells)
    return len(row) > 1 and numbers >= 1 and 2 * numbers >= len(cells)


def _width(rows: Sequence[Sequence[str]]) -> int:
    """Return the commonest number of cells."""
    return Counter(map(len, rows)).most_common(1)[0][0] if rows else 0


def _score(rows: Sequence[Sequence[str]], decimal: str) -> tuple[int, int]:
    """Return how many rows of equal width hold numbers, and how many numbers they hold, those with a point twice."""
    data = [r for r in rows if _is_data(r, decimal)]
    width = _width(data)
    same = [r for r in data if len(r) == width]
    return len(same), sum(1 + (decimal in c) for r in same for c in r if _is_number(c, decimal))


def _described(path: Path, rows: list[list[str]], dialect: Dialect) -> TableHead:
    """Tell header, row of units and numbers apart."""
    data = [i for i, r in enumerate(rows) if _is_data(r, dialect.decimal)]
    width = _width([rows[i] for i in data])
    first = next((i for i in data if len(rows[i]) == width and (i + 1 >= len(rows) or i + 1 in data)), data[0])
    cells = tuple(tuple(rows[i]) for i in data if i >= first)[: RULE.rows]
    written = sum(bool(c) for c in cells[0])
    above = [i for i in range(first) if 2 * sum(map(bool, rows[i])) >= written and abs(len(rows[i]) - width) <= 1]
    placed = {"header": False, "skip_rows": first}
    if above:
        unit_row = next((i for i in above[1:] if is_unit_row(rows[i])), None)
        header = above[-1] if unit_row is None else above[above.index(unit_row) - 1]
        placed = {"skip_rows": header, "unit_rows": first - header - 1}
    return TableHead(**vars(Table.open(path, dialect.model_copy(update=placed))), rows=cells)
