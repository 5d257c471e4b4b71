"""`kros init`: look at a folder of recordings, write the study that runs on it, and say what looks wrong."""

from __future__ import annotations

import os
import tomllib
from collections.abc import Sequence
from pathlib import Path

from ...core import ByName, ConfigError, DataError, Progress, Record, Work, write_bytes, write_json
from ...data import Population, detect_reader
from ...data.discovery.discover import Discovery, Wanted, discover
from ...data.recording import check_population
from ...identify.survey import UNLOADED, survey
from ..config import study_schema, validate_config
from ..stages.learning import FEWEST, fewest_samples, open_source
from .mapping_text import comment, key_lines, mapping_lines


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
    ]
    lines += ["# [lifting]", '# functions = ["sin(angle)", "sin(100*angle + phase)"]']
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
    lines = [repr(population), *([discovery.reading] if discovery else [])]
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
