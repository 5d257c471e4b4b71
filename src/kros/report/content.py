"""What a page is made of, and the one builder of its tables. The template turns it into HTML and escapes every text.

To add a column to a table, add one `Column` where the section builds it: a title and the key of its values in the rows.
"""

from collections.abc import Sequence
from itertools import groupby
from math import isfinite
from typing import Any

from ..core import frozen
from .names import number

Row = dict[Any, Any]  # values by key
Pairs = Sequence[tuple[str, Sequence[str]]]


@frozen
class Column:
    """A column of a table before it is formatted; one in which nothing is known is left out."""

    title: str
    key: Any = None  # of its values in the rows, by default the title: a number, a text, a truth value or None
    group: str = ""  # title over columns that stand together
    best: bool = False  # whether the smallest number is set in bold
    note: Any = None  # key of a small text below each value

    def value(self, row: Row) -> Any:
        """Return the value in a row."""
        return row.get(self.title if self.key is None else self.key)


@frozen
class Cell:
    """A cell of a table."""

    text: str
    strong: bool = False
    note: str = ""
    value: float | None = None  # what the cell is sorted by; its text by default


@frozen
class Table:
    """A table as the template shows it; the first column names the rows."""

    caption: str
    head: Sequence[str]
    rows: Sequence[Sequence[Cell]]
    groups: Sequence[tuple[str, int]] = ()  # titles over several columns each, the first column included
    labels: Sequence[str] = ()  # what a column is called where it stands alone
    chosen: Sequence[int] = ()  # rows that are set off
    sortable: bool = False  # whether the reader sorts it by any column, and filters its rows by their text
    folded: bool = False  # whether the reader opens it
    prose: bool = False  # whether cells hold sentences


@frozen
class Section:
    """A section of the report: paragraphs, lists by what they are of, tables, and one figure."""

    key: str  # anchor
    title: str
    paragraphs: Sequence[str] = ()
    card: Pairs = ()
    tables: Sequence[Table | None] = ()
    figure: str = ""


def build(
    caption: str, columns: Sequence[Column], rows: Sequence[Row], chosen: str | None = None, **options: bool
) -> Table | None:
    """Return a table of columns, the row whose first cell is `chosen` set off; None where it has no rows."""
    first, *others = columns
    known = [first, *(c for c in others if any(_known(c.value(row)) for row in rows))]
    if not rows or len(known) < 2:
        return None
    cells = zip(*(_cells(column, rows) for column in known), strict=True)
    groups = [(title, len(list(columns_of))) for title, columns_of in groupby(known, key=lambda c: c.group)]
    labels = [": ".join(filter(None, (column.group, column.title))) for column in known]
    marked = [k for k, row in enumerate(rows) if first.value(row) == chosen]
    titled = groups if any(title for title, _ in groups) else ()
    return Table(caption, [c.title for c in known], list(cells), titled, labels, marked, **options)


def _known(value: Any) -> bool:
    """Tell whether a value says something."""
    return value is not None and value != "" and not (isinstance(value, float) and not isfinite(value))


def _cells(column: Column, rows: Sequence[Row]) -> list[Cell]:
    """Return the cells of a column."""
    values = [column.value(row) for row in rows]
    least = min((v for v in values if isinstance(v, float) and isfinite(v)), default=None) if column.best else None
    return [_cell(value, row.get(column.note, ""), least) for value, row in zip(values, rows, strict=True)]


def _cell(value: Any, note: str, least: float | None) -> Cell:
    """Return one value as a cell."""
    if isinstance(value, bool):
        return Cell("yes" if value else "no", strong=not value, note=note)
    if isinstance(value, str) and value:
        return Cell(value, note=note)
    size = float(value) if isinstance(value, int | float) else None
    text = str(value) if isinstance(value, int) else number(size)
    return Cell(text, strong=size is not None and size == least, note=note, value=size)
