"""The study that `kros init` writes: TOML with comments that say what each line rests on."""

from __future__ import annotations

import json
import textwrap
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from ...data.discovery.discover import Discovery
from ...data.discovery.roles import ColumnPart, TableColumn
from ...data.readers.csv_mapping import CsvMapping


@dataclass(frozen=True)
class LiftingProposal:
    """Tables ``[lifting]`` and ``[calibrate]``, and what they rest on."""

    lifting: dict[str, Any] = field(default_factory=dict)
    calibrate: dict[str, Any] = field(default_factory=dict)
    why: str = "no periodic nonlinearity was found"


def study_text(
    source: Path,
    data: Mapping[str, Any],
    discovery: Discovery | None,
    proposal: LiftingProposal,
    findings: Sequence[str],
) -> str:
    """Return a study as TOML."""
    written = f"Written by kros init from the recordings in {source.name}. It can be run as it is; edit any line."
    lines = _comment(written)
    if findings:
        lines += ["#", "# What looks wrong:", *(line for text in findings for line in _comment(f"- {text}"))]
    lines += ["", "[data]", *_keys({key: data[key] for key in ("source", "reader", "on_nan") if key in data})]
    identify_on = _keys({"identify_on": data.get("identify_on", "...")})[0]
    prefix = "" if "identify_on" in data else "# "
    lines += [f"{prefix}{identify_on}  # condition that models and observers are made from, where there are several"]
    lines += ['# exclude = ["..."]  # units that take no part']
    lines += _mapping(discovery) if discovery is not None else []
    for step in data.get("prepare", ()):
        lines += ["", "[[data.prepare]]", *_keys(step)]
    lines += ["", *_comment(f"Lifted functions: {proposal.why}.")]
    example = '# functions = ["sin(angle)"]  # nonlinear terms that you know of; without any, models are linear'
    lines += ["[lifting]", *_keys(proposal.lifting)] if proposal.lifting else ["# [lifting]", example]
    if proposal.calibrate:
        where = "Where the phase of every unit is found: in the error of a speed that is held constant."
        lines += ["", *_comment(where), "[calibrate]", *_keys(proposal.calibrate)]
    return "\n".join(lines) + "\n"


def _keys(table: Mapping[str, Any]) -> list[str]:
    return [f"{key} = {_value(value)}" for key, value in table.items()]


def _mapping(discovery: Discovery) -> Iterator[str]:
    """Yield the lines of ``[data.csv]``, columns that were left out as comments."""
    yield from ("", "[data.csv]")
    for key, value in discovery.mapping.items():
        if key != "channel":
            yield from _comment(discovery.reading) if key == "files" else ()
            known = "" if key == "files" else CsvMapping.model_fields[key].description or ""
            yield _line(key, value, discovery.notes.get(key, known))
    by_name = {c.name: c for c in discovery.columns}
    for channel in discovery.mapping["channel"]:
        yield from ("", "[[data.csv.channel]]", *_channel(channel, by_name[channel["name"]]))
    spare = [c for c in discovery.columns if c.part is ColumnPart.LEFT_OUT and c.why != "no numbers"]
    if spare:
        roles = "a channel of the role state is estimated, one of the role input is known at run time"
        yield from ("", f"# Columns that were left out; {roles}.")
    for column in spare:
        table = {"name": column.name, "column": column.reference, "role": "state"}
        table |= {"unit": column.unit} if column.unit else {}
        yield from ("", *(f"# {line}" for line in ("[[data.csv.channel]]", *_channel(table, column))))


def _channel(table: Mapping[str, Any], column: TableColumn) -> Iterator[str]:
    for key, value in table.items():
        note = {"role": column.why, "measured": "available at run time", "scale": "to " + column.unit}.get(key, "")
        yield _line(key, value, note)


def _line(key: str, value: Any, note: str) -> str:
    return f"{key} = {_value(value)}{f'  # {_one_line(note)}' if note else ''}"


def _value(value: Any) -> str:
    if isinstance(value, bool):
        return "true" if value else "false"
    if isinstance(value, str):
        literal = "\\" in value and "'" not in value and value.isprintable()
        return f"'{value}'" if literal else json.dumps(value, ensure_ascii=False).replace("\x7f", "\\u007f")
    if isinstance(value, (list, tuple)):
        return f"[{', '.join(_value(v) for v in value)}]"
    return repr(value)


def _one_line(text: str) -> str:
    return "".join(c if c.isprintable() else " " for c in text)


def _comment(text: str) -> list[str]:
    later = "#   " if text.startswith("- ") else "# "
    indents: dict[str, Any] = {"initial_indent": "# ", "subsequent_indent": later}
    return textwrap.wrap(_one_line(text), 118, break_on_hyphens=False, **indents)
