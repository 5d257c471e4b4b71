"""What a page is made of: sections with paragraphs, tables and figures. The template turns it into HTML, text is escaped there."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from enum import Enum


class Level(Enum):
    """How urgent something is, with its word: colour alone says nothing to everybody."""

    GO = "ready"
    LOOK = "look first"
    STOP = "do not use"


@dataclass(frozen=True)
class Alert:
    """What has to be looked at; `section` is the anchor of where it comes from."""

    level: Level
    text: str
    section: str


@dataclass(frozen=True)
class Cell:
    """A cell of a table."""

    text: str
    strong: bool = False  # Best of its column, or worth seeing
    note: str = ""  # Shown smaller, behind the text
    bar: float | None = None  # Share of the cell's width that is shaded, 0 to 1
    value: float | None = None  # What the cell is sorted by; its text by default


Cells = Sequence[Cell | str]


@dataclass(frozen=True)
class Table:
    """A table; the first column names the rows."""

    head: Sequence[str]
    rows: Sequence[Cells]  # a plain text stands for a cell
    caption: str = ""
    groups: Sequence[tuple[str, int]] = ()  # titles over several columns each, the first column included
    folded: bool = False  # whether the reader opens it
    emphasised: Sequence[int] = ()  # rows that are set off
    prose: bool = False  # whether cells hold sentences instead of numbers
    sortable: bool = False  # whether the reader sorts it by any column, and filters its rows by their text

    @property
    def cells(self) -> list[list[Cell]]:
        """All rows as cells."""
        return [[Cell(c) if isinstance(c, str) else c for c in row] for row in self.rows]

    @property
    def labels(self) -> list[str]:
        """What every column is called where it stands alone: its group's title and its own."""
        titles = [title for title, span in self.groups for _ in range(span)] or [""] * len(self.head)
        return [
            f"{title}: {own}" if title and own else title or own for title, own in zip(titles, self.head, strict=True)
        ]


@dataclass(frozen=True)
class Section:
    """A section of the report; figures are named and come after the tables."""

    key: str  # Anchor
    title: str
    paragraphs: Sequence[str] = ()
    tables: Sequence[Table] = ()
    figures: Sequence[str] = ()
    folded: Sequence[
        tuple[str, str]
    ] = ()  # sequence of (str, str); Titles and preformatted texts that the reader opens
    lists: Sequence[
        tuple[str, Sequence[str]]
    ] = ()  # sequence of (str, sequence of str); Titles and sentences, one below the other
    card: Sequence[
        tuple[str, Sequence[str]]
    ] = ()  # sequence of (str, sequence of str); Terms and what there is to say about them
    notes: Sequence[str] = ()  # Paragraphs behind the tables


def where(names: Iterable[str], name: str | None) -> list[int]:
    """Return the places of a name, for rows that are set off."""
    return [i for i, one in enumerate(names) if one == name]
