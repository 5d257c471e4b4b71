"""`kros init`: look at a folder of recordings, write the study that runs on it, and say what looks wrong."""

import json
import os
import textwrap
import tomllib
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

from ...core import ByName, ConfigError, DataError, Progress, Record, Work, write_bytes, write_json
from ...data import Population, detect_reader
from ...data.discovery.discover import Discovery, Wanted, discover
from ...data.discovery.roles import ColumnPart
from ...data.readers.csv_folder import CsvMapping
from ...data.recording import check_population
from ...identify.survey import UNLOADED, survey
from ..config import study_schema, validate_config
from ..stages.learning import FEWEST, fewest_samples, open_source


def study_text(source: Path, data: ByName, discovery: Discovery | None, findings: Sequence[str]) -> str:
    """Return a study as TOML."""
    written = f"Written by kros init from the recordings in {source.name}. It can be run as it is; edit any line."
    lines = [f"#:schema ./{SCHEMA}", *comment(written)]
    if findings:
        lines += ["#", "# What looks wrong:", *(line for text in findings for line in comment(f"- {text}"))]
    keys = {key: data[key] for key in ("source", "reader", "identify_on") if data.get(key)}
    lines += ["", "[data]", *key_lines(keys), '# exclude = ["..."]  # units that take no part']
    lines += mapping_lines(discovery) if discovery is not None else []
    for step in data.get("prepare", ()):
        lines += ["", "[[data.prepare]]", *key_lines(step)]
    lines += [
        "",
        "# Nonlinear terms that you know of, such as gravity or a gear's ratio; without any, models are linear.",
        "# [lifting]",
        '# functions = ["sin(angle)", "sin(100*angle + phase)"]',
    ]
    return "\n".join(lines) + "\n"


SCHEMA = "study.schema.json"  # which editors look up by the first line of a study


def init_study(source: Path, out: Path, wanted: Wanted, progress: Progress) -> list[str]:
    """Write a study for a folder of recordings; return what people read at the terminal."""
    if out.exists():
        raise ConfigError(f"Output {out}: exists; name another file, --out FILE, or remove it.")
    if not source.is_dir():
        raise DataError(f"Looking at {source}: there is no such folder; name the folder that holds the recordings.")
    work, reader, discovery = Work(progress=progress), detect_reader(source) or "csv", None
    data: Record = {"source": _source(source, out), "reader": reader}
    if reader == "csv":
        discovery = discover(source, wanted, work, fewest_samples())
        data |= {"csv": discovery.mapping, "prepare": list(discovery.prepare)}
    elif wanted != Wanted():
        reason = f"these are {reader} recordings, which say what channels are"
        raise ConfigError(f"Looking at {source}: {reason}; leave out --measured, --input, --files and --period.")
    folder = out.parent.absolute()
    population = open_source(validate_config({"data": dict(data)}, folder, str(out)))
    data["identify_on"] = condition = _condition(population)
    findings = list(discovery.findings if discovery else ())
    try:
        check_population(population, allow_single=True)
        population, facts = survey(population, work, identify_on=condition, fewest=fewest_samples())
        findings += facts.alerts
    except DataError as error:
        findings.append(f"kros run would refuse this: {error}")
    text = study_text(source, data, discovery, findings)
    validate_config(tomllib.loads(text), folder, str(out))
    write_bytes(out, text.encode())
    write_json(out.with_name(SCHEMA), study_schema())
    until = " --until identify" if len(population.units) < FEWEST else ""
    lines = [*population.summary().splitlines()[1:], *([discovery.reading] if discovery else [])]
    lines += [f"looks wrong: {text}" for text in findings]
    return [*lines, f"study: {out}; read it, then run: kros run {out}{until}"]


def _source(source: Path, out: Path) -> str:
    try:
        return Path(os.path.relpath(source.absolute(), out.absolute().parent)).as_posix()
    except ValueError:  # on another drive
        return str(source.absolute())


def _condition(population: Population) -> str | None:
    """Return the condition that most units have, where there are several and none has the name of the default."""
    conditions = population.conditions
    if len(conditions) < 2 or UNLOADED in conditions:
        return None
    return max(conditions, key=lambda c: len({k.unit for k in population.keys(condition=c)}))


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
    return textwrap.wrap(_one_line(text), 118, break_on_hyphens=False, initial_indent="# ", subsequent_indent=later)
