"""What a page is made of: sections with paragraphs, tables and figures. The template turns it into HTML, text is escaped there."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass


@dataclass(frozen=True)
class Cell:
    """A cell of a table.

    Parameters
    ----------
    text : str
    strong : bool
        Best of its column, or worth seeing.
    note : str
        Shown smaller, behind the text.
    bar : float or None
        Share of the cell's width that is shaded, 0 to 1.
    """

    text: str
    strong: bool = False
    note: str = ""
    bar: float | None = None


Cells = Sequence[Cell | str]


@dataclass(frozen=True)
class Table:
    """A table; the first column names the rows.

    Parameters
    ----------
    head : sequence of str
    rows : sequence of sequence of Cell
        A plain text stands for a cell.
    caption : str
    groups : sequence of (str, int)
        Titles over several columns each, the first column included; none by default.
    folded : bool
        Whether the reader opens it.
    emphasised : sequence of int
        Rows that are set off.
    prose : bool
        Whether cells hold sentences instead of numbers.
    """

    head: Sequence[str]
    rows: Sequence[Cells]
    caption: str = ""
    groups: Sequence[tuple[str, int]] = ()
    folded: bool = False
    emphasised: Sequence[int] = ()
    prose: bool = False

    @property
    def cells(self) -> list[list[Cell]]:
        """All rows as cells."""
        return [[Cell(c) if isinstance(c, str) else c for c in row] for row in self.rows]


@dataclass(frozen=True)
class Section:
    """A section of the report; figures are named and come after the tables.

    Parameters
    ----------
    key : str
        Anchor.
    title : str
    paragraphs : sequence of str
    tables : sequence of Table
    figures : sequence of str
    folded : sequence of (str, str)
        Titles and preformatted texts that the reader opens.
    more : sequence of (str, sequence of str)
        Titles and names of further figures that the reader opens.
    """

    key: str
    title: str
    paragraphs: Sequence[str] = ()
    tables: Sequence[Table] = ()
    figures: Sequence[str] = ()
    folded: Sequence[tuple[str, str]] = ()
    more: Sequence[tuple[str, Sequence[str]]] = ()


def where(names: Iterable[str], name: str | None) -> list[int]:
    """Return the places of a name, for rows that are set off."""
    return [i for i, one in enumerate(names) if one == name]
