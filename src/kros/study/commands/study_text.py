"""The study that `kros init` writes: TOML with comments that say what each line rests on."""

from __future__ import annotations

import json
import textwrap
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

from ...data.discovery.discover import Discovery
from ...data.discovery.roles import ColumnPart, TableColumn

COMMENTS = {
    "files": "what a file is: a regular expression on its path, whose groups unit, condition, episode and group are read",
    "exclude": "left out; the reasons are above",
    "time": "column of time",
    "time_scale": "from the column of time to seconds",
    "timestamp": "time is written as dates and times of day",
    "sample_period_s": "there is no column of time",
    "decimal": "decimal comma",
    "encoding": "of the text",
    "skip_rows": "lines before the header",
    "unit_rows": "lines between the header and the numbers",
    "header": "the first line holds numbers already",
    "pieces": "episodes that every file is cut into",
}


def study_text(
    source: Path,
    data: Mapping[str, Any],
    found: Discovery | None,
    lifting: Mapping[str, Any],
    calibrate: Mapping[str, Any],
    why: str,
    findings: Sequence[str],
) -> str:
    """Return a study as TOML."""
    lines = [
        *_comment(
            f"Written by kros init from the recordings in {source.name}. kros run takes it as it is; every line may be corrected."
        )
    ]
    if findings:
        lines += ["#", "# What looks wrong:", *(line for text in findings for line in _comment(f"- {text}"))]
    lines += ["", "[data]", *(f"{key} = {_value(data[key])}" for key in ("source", "reader", "on_nan") if key in data)]
    condition = _value(data["identify_on"]) if "identify_on" in data else None
    identify_on = '# identify_on = "..."' if condition is None else f"identify_on = {condition}"
    lines += [f"{identify_on}  # condition that models and observers are made from, where there are several"]
    lines += ['# exclude = ["..."]  # units that take no part']
    if found is not None:
        lines += _mapping(found)
    for step in data.get("prepare", ()):
        lines += ["", "[[data.prepare]]", *(f"{key} = {_value(value)}" for key, value in step.items())]
    lines += ["", *_comment(f"Lifted functions: {why}.")]
    if lifting:
        lines += ["[lifting]", *(f"{key} = {_value(value)}" for key, value in lifting.items())]
    else:
        lines += [
            "# [lifting]",
            '# functions = ["sin(angle)"]  # nonlinear terms that you know of; without any, models are linear',
        ]
    if calibrate:
        lines += [
            "",
            *_comment("Where the phase of every unit is found: in the error of a speed that is held constant."),
        ]
        lines += ["[calibrate]", *(f"{key} = {_value(value)}" for key, value in calibrate.items())]
    return "\n".join(lines) + "\n"


def _mapping(found: Discovery) -> Iterator[str]:
    yield from ("", "[data.csv]")
    for key, value in found.mapping.items():
        if key != "channel":
            note = found.notes.get(key, COMMENTS.get(key, ""))
            if key == "files":
                yield from _comment(found.reading)
            yield f"{key} = {_value(value)}{f'  # {_one_line(note)}' if note else ''}"
    by_name = {c.name: c for c in found.columns}
    for channel in found.mapping["channel"]:
        yield from ("", "[[data.csv.channel]]", *_channel(channel, by_name[channel["name"]]))
    spare = [c for c in found.columns if c.part is ColumnPart.LEFT_OUT and c.why != "no numbers"]
    if spare:
        yield from (
            "",
            "# Columns that were left out; a channel of the role state is estimated, one of the role input is known at run time.",
        )
    for column in spare:
        table = {
            "name": column.name,
            "column": column.reference,
            "role": "state",
            **({"unit": column.unit} if column.unit else {}),
        }
        yield from ("", *(f"# {line}" for line in ("[[data.csv.channel]]", *_channel(table, column))))


def _channel(table: Mapping[str, Any], column: TableColumn) -> Iterator[str]:
    for key, value in table.items():
        note = {"role": column.why, "measured": "available at run time", "scale": "to " + column.unit}.get(key, "")
        yield f"{key} = {_value(value)}{f'  # {_one_line(note)}' if note else ''}"


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
    return textwrap.wrap(
        _one_line(text),
        118,
        initial_indent="# ",
        subsequent_indent="#   " if text.startswith("- ") else "# ",
        break_on_hyphens=False,
    )
