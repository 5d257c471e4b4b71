"""`kros init`: look at a folder of recordings, write the study that runs on it, and say what looks wrong."""

from __future__ import annotations

import json
import logging
import os
import re
import textwrap
import tomllib
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from ...core.errors import ConfigError, DataError, IdentificationError
from ...core.work import Progress, Work
from ...data import Population, Role
from ...data.discovery.discover import Discovery, Wanted, discover
from ...data.discovery.roles import ColumnPart, TableColumn, is_commanded, kind_of
from ...data.readers.csv_folder import CsvMapping
from ...data.readers.opening import detect_reader
from ...data.recording import check_population
from ...data.survey import UNLOADED, RecordingFacts, survey
from ...identify import PhaseSpec
from ...identify.calibration import calibrate
from ...identify.periodic import PeriodicTerm, periodic_term
from ...identify.presets import HARMONIC_DRIVE
from ..config import validate_config
from ..stages.learning import FEWEST, open_source


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
    """Yield the lines of ``[data.csv]``."""
    yield from ("", "[data.csv]")
    for key, value in discovery.mapping.items():
        if key != "channel":
            yield from _comment(discovery.reading) if key == "files" else ()
            known = "" if key == "files" else CsvMapping.model_fields[key].description or ""
            yield _line(key, value, discovery.notes.get(key, known))
    for column in discovery.columns:
        if column.part is ColumnPart.LEFT_OUT:
            yield from _comment(f"left out: column {column.reference!r} ({column.why})")
    by_name = {c.name: c for c in discovery.columns}
    for channel in discovery.mapping["channel"]:
        yield from ("", "[[data.csv.channel]]", *_channel(channel, by_name[channel["name"]]))


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


log = logging.getLogger(__name__)
_UNLOADED_WORDS = "unloaded noload leerlauf ohnelast unbelastet leer idle empty vide avide sanscharge"
NO_LOAD = _UNLOADED_WORDS.split()


def init_study(source: Path, out: Path, wanted: Wanted, progress: Progress) -> list[str]:
    """Write a study for a folder of recordings; return what people read at the terminal."""
    if out.exists():
        raise ConfigError(f"Output {out}: exists; name another file, --out FILE, or remove it.")
    if not source.is_dir():
        raise DataError(f"Looking at {source}: there is no such folder; name the folder that holds the recordings.")
    work = Work(progress=progress)
    reader, discovery = detect_reader(source), None
    if reader in ("parquet", "motor-drive-raw"):
        if wanted != Wanted():
            says = f"these are {reader} recordings, which say what channels are"
            raise ConfigError(f"Looking at {source}: {says}; leave out --measured, --input, --files and --period.")
        data: dict[str, Any] = {"source": _source(source, out), "reader": reader}
    else:
        discovery = discover(source, wanted, work)
        data = {"source": _source(source, out), "reader": "csv", "csv": discovery.mapping}
        data |= {"on_nan": "drop_episode"} if discovery.drop_nan else {}
        data |= {"prepare": list(discovery.prepare)} if discovery.prepare else {}
    folder = out.parent.absolute()
    population = open_source(validate_config({"data": dict(data)}, folder, str(out)))
    unloaded = _unloaded(population)
    data |= {} if unloaded is None else {"identify_on": unloaded}
    findings, proposal = list(discovery.findings if discovery else ()), LiftingProposal(why="not searched for")
    try:
        check_population(population, allow_single=True)
        population, facts = survey(population, work, identify_on=unloaded, on_nan=data.get("on_nan", "error"))
        findings += facts.alerts
        proposal = propose_lifting(population, facts)
    except DataError as error:
        findings.append(f"kros run would refuse this: {error}")
    text = study_text(source, data, discovery, proposal, findings)
    validate_config(tomllib.loads(text), folder, str(out))
    out.parent.mkdir(parents=True, exist_ok=True)
    out.write_text(text, encoding="utf-8")
    until = " --until identify" if len(population.units) < FEWEST else ""
    lines = [repr(population), *([discovery.reading] if discovery else []), f"lifting: {proposal.why}"]
    lines += [f"looks wrong: {text}" for text in findings]
    return [*lines, f"study: {out}; read it, then run: kros run {out}{until}"]


def _source(source: Path, out: Path) -> str:
    try:
        return Path(os.path.relpath(source.absolute(), out.absolute().parent)).as_posix()
    except ValueError:  # on another drive
        return str(source.absolute())


def _unloaded(population: Population) -> str | None:
    """Return the condition without load where its name is not the default, else the one that most units have."""
    conditions = population.conditions
    if len(conditions) < 2 or UNLOADED in conditions:
        return None
    named = [c for c in conditions if re.sub(r"[\W_]", "", c.lower()) in NO_LOAD]
    return named[0] if named else max(conditions, key=lambda c: len({k.unit for k in population.keys(condition=c)}))


def propose_lifting(population: Population, facts: RecordingFacts) -> LiftingProposal:
    """Return lifted functions where recordings ask for them: the periodic term of an angle, with a phase per unit."""
    if population.metadata.get("plant") == HARMONIC_DRIVE:
        return LiftingProposal(why="the recordings name their plant, which has a known lifting")
    measured = [c for c in population.channels if c.role is Role.STATE and c.measured]
    angles = [c.name for c in measured if c.unit == "rad" or (not c.unit and kind_of(c.name) in ("angle", "position"))]
    keys = [k for u in facts.pooled[:6] for k in facts.keys("train", u, facts.identify_on)[:3]]
    term = periodic_term(population, angles, keys) if angles and keys else None
    if term is None:
        return LiftingProposal()
    share = f"{100 * term.share:.2g} % of"
    if term.ratio == 1:
        why = f"sin({term.angle}), as of gravity, explains {share} the one-step residual of a linear model"
        functions = [f"{f}({term.angle})" for f in (("sin",) if term.odd else ("sin", "cos"))]
        return LiftingProposal({"functions": functions}, {}, why)
    above = f"{term.above:.0f} times the residual at neighbouring ratios; {share} the whole residual"
    why = f"the residual of a linear model repeats {term.ratio:g} times per turn of {term.angle!r} ({above})"
    spec = _phase_spec(population, term)
    if spec is not None and _calibrates(population, facts, spec):
        names = ("angle", "ratio", "reference", "measured")
        function = f"sin({term.ratio:g}*{term.angle} + phase)"
        table = {name: getattr(spec, name) for name in names}
        return LiftingProposal({"functions": [function]}, table, f"{why}; the phase differs from unit to unit")
    return LiftingProposal({"functions": [f"{f}({term.ratio:g}*{term.angle})" for f in ("sin", "cos")]}, {}, why)


def _phase_spec(population: Population, term: PeriodicTerm) -> PhaseSpec | None:
    """Return what a phase can be calibrated on: a speed that is commanded and the speed that follows it."""
    speeds = [c for c in population.channels if kind_of(c.name, c.unit) == "velocity"]
    reference = [c.name for c in speeds if c.role is Role.INPUT and is_commanded(c.name)]
    measured = [c.name for c in speeds if c.role is Role.STATE]
    return PhaseSpec(term.angle, term.ratio, reference[0], measured[0]) if reference and measured else None


def _calibrates(population: Population, facts: RecordingFacts, spec: PhaseSpec) -> bool:
    """Tell whether the phase of every unit can be found in its recordings."""
    try:
        return set(calibrate(population, facts, spec).units) == set(facts.groups)
    except IdentificationError as error:
        log.info("%s", error)
        return False
