"""What was found in a folder, as a mapping in TOML that people can read and correct."""

from __future__ import annotations

import json
import textwrap
from collections.abc import Iterator
from typing import Any

from ...core import ByName, Record
from ...data.discovery.discover import Discovery
from ...data.discovery.roles import ColumnPart
from ...data.readers.csv_folder import CsvMapping


def key_lines(table: ByName) -> list[str]:
    """Return the keys of a table."""
    return [f"{key} = {_value(value)}" for key, value in table.items()]


def mapping_lines(discovery: Discovery) -> Iterator[str]:
    """Yield the lines of ``[data.csv]``."""
    yield from ("", "[data.csv]")
    for key, value in discovery.mapping.items():
        if key != "channel":
            yield from comment(discovery.reading) if key == "files" else ()
            known = "" if key == "files" else CsvMapping.model_fields[key].description or ""
            yield _line(key, value, discovery.notes.get(key, known))
    for column in discovery.columns:
        if column.part is ColumnPart.LEFT_OUT:
            yield from comment(f"left out: column {column.reference!r} ({column.why})")
    by_name = {c.name: c for c in discovery.columns}
    for channel in discovery.mapping["channel"]:
        column = by_name[channel["name"]]
        notes = {"role": column.why, "measured": "available at run time", "scale": f"to {column.unit}"}
        yield from ("", "[[data.csv.channel]]", *(_line(key, of, notes.get(key, "")) for key, of in channel.items()))


def _line(key: str, value: Any, note: str) -> str:
    return f"{key} = {_value(value)}{f'  # {_one_line(note)}' if note else ''}"


def _value(value: Any) -> str:
    if isinstance(value, dict):
        return f"{{ {', '.join(key_lines(value))} }}"
    if isinstance(value, str) and "\\" in value and "'" not in value and value.isprintable():
        return f"'{value}'"
    return json.dumps(value, ensure_ascii=False).replace("\x7f", "\\u007f")  # TOML writes the rest as JSON does


def _one_line(text: str) -> str:
    return "".join(c if c.isprintable() else " " for c in text)


def comment(text: str) -> list[str]:
    """Return a text as lines of comment."""
    later = "#   " if text.startswith("- ") else "# "
    indents: Record = {"initial_indent": "# ", "subsequent_indent": later}
    return textwrap.wrap(_one_line(text), 118, break_on_hyphens=False, **indents)
