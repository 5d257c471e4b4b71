"""`kros init`: look at a folder of recordings, write the study that runs on it, and say what looks wrong."""

from __future__ import annotations

import logging
import os
import re
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from ...core.errors import ConfigError, DataError, IdentificationError
from ...core.files import parse_toml
from ...core.work import Progress, Work
from ...data import Population, Role
from ...data.checks import check_population
from ...data.discovery.discover import Ask, Discovery, Wanted, discover
from ...data.discovery.roles import ColumnPart, TableColumn, is_commanded, kind_of
from ...data.readers.opening import LOOKS, detect_reader
from ...data.recording import some
from ...data.survey import UNLOADED, RecordingFacts, survey
from ...identify import PhaseSpec
from ...identify.calibrate import calibrate
from ...identify.periodic import PeriodicTerm, periodic_term
from ...identify.presets import HARMONIC_DRIVE
from ..config import StudyConfig, validate_config
from ..stages.read import FEWEST, open_source
from .study_text import study_text

log = logging.getLogger(__name__)
MOST_FINDINGS = 12
NO_LOAD = (
    "unloaded",
    "noload",
    "leerlauf",
    "ohnelast",
    "unbelastet",
    "leer",
    "idle",
    "empty",
    "vide",
    "avide",
    "sanscharge",
)


@dataclass(frozen=True)
class Initialised:
    """What `kros init` wrote, and what it says."""

    study: Path
    lines: tuple[str, ...]
    findings: tuple[str, ...]


@dataclass(frozen=True)
class LiftingProposal:
    """Tables ``[lifting]`` and ``[calibrate]``, and what they rest on."""

    lifting: dict[str, Any] = field(default_factory=dict)
    calibrate: dict[str, Any] = field(default_factory=dict)
    why: str = "no periodic term of an angle stands out in what a linear model leaves"


def init_study(source: Path, out: Path, wanted: Wanted, ask: Ask | None, progress: Progress) -> Initialised:
    """Write a study for a folder of recordings."""
    if out.exists():
        raise ConfigError(f"Output {out}: exists; name another file, --out FILE, or remove it.")
    if not source.is_dir():
        raise DataError(f"Looking at {source}: there is no such folder; name the folder that holds the recordings.")
    work = Work(progress=progress)
    data: dict[str, Any] = {"source": _source(source, out), "reader": "csv"}
    reader, found = detect_reader(source), None
    if reader in ("parquet", "motor-drive-raw"):
        if wanted != Wanted():
            raise ConfigError(
                f"Looking at {source}: it {LOOKS[reader]}, which says what channels are; leave out --measured, --input, --files and --period."
            )
        data["reader"] = reader
    else:
        found = discover(source, wanted, ask, work)
        data |= {"on_nan": "drop_episode"} if found.drop_nan else {}
        data |= {"csv": found.mapping} | ({"prepare": list(found.prepare)} if found.prepare else {})
    config = validate_config({"data": dict(data)}, out.parent.absolute(), str(out))
    unloaded = _unloaded(open_source(config))
    if unloaded is not None:
        data["identify_on"] = unloaded
        config = validate_config({"data": dict(data)}, out.parent.absolute(), str(out))
    population, facts, refused = _surveyed(config, work)
    proposal = propose_lifting(population, facts) if facts is not None else LiftingProposal(why="not looked for")
    findings = (
        *(found.findings if found else ()),
        *(facts.alerts if facts else ()),
        *((f"kros run would refuse this: {refused}",) if refused else ()),
    )
    text = study_text(source, data, found, proposal.lifting, proposal.calibrate, proposal.why, findings)
    validate_config(parse_toml(text), out.parent.absolute(), str(out))
    out.parent.mkdir(parents=True, exist_ok=True)
    out.write_text(text, encoding="utf-8")
    return Initialised(out, tuple(_lines(population, found, proposal, findings, out)), findings)


def _source(source: Path, out: Path) -> str:
    try:
        return Path(os.path.relpath(source.absolute(), out.absolute().parent)).as_posix()
    except ValueError:  # on another drive
        return str(source.absolute())


def _unloaded(population: Population) -> str | None:
    """Return the condition without load, where it is called otherwise than the default expects; else the one that most units have."""
    conditions = population.conditions
    if len(conditions) < 2 or UNLOADED in conditions:
        return None
    named = [c for c in conditions if re.sub(r"[\W_]", "", c.lower()) in NO_LOAD]
    return named[0] if named else max(conditions, key=lambda c: len({k.unit for k in population.keys(condition=c)}))


def _surveyed(config: StudyConfig, work: Work) -> tuple[Population, RecordingFacts | None, str]:
    """Open and check the recordings as a study does; return what it would refuse them for in place of the facts."""
    population = open_source(config)
    try:
        check_population(population, allow_single=True)
        kept, facts = survey(population, identify_on=config.data.identify_on, on_nan=config.data.on_nan, work=work)
        return kept, facts, ""
    except DataError as error:
        return population, None, str(error)


def propose_lifting(population: Population, facts: RecordingFacts) -> LiftingProposal:
    """Return lifted functions where recordings ask for them: the periodic term of an angle, with the phase of every unit where it can be calibrated."""
    if population.metadata.get("plant") == HARMONIC_DRIVE:
        return LiftingProposal(why="these recordings say which plant they are of, and its own lifting is taken")
    angles = [
        c.name for c in population.channels if c.role is Role.STATE and c.measured and _may_be_angle(c.name, c.unit)
    ]
    keys = [k for u in facts.pooled[:6] for k in facts.keys("train", u, facts.identify_on)[:3]]
    term = periodic_term(population, angles, keys) if angles and keys else None
    if term is None:
        return LiftingProposal()
    if term.ratio == 1:
        why = f"sin({term.angle}), as of gravity, explains {100 * term.share:.2g} % of what a linear model of one step leaves"
        return LiftingProposal(
            {"functions": [f"{f}({term.angle})" for f in (("sin",) if term.odd else ("sin", "cos"))]}, {}, why
        )
    why = (
        f"what a linear model of one step leaves repeats {term.ratio:g} times a turn of {term.angle!r} ({term.above:.0f} times what is left at ratios "
        f"around; {100 * term.share:.2g} % of the residual)"
    )
    spec = _phase_spec(population, term)
    if spec is not None and _calibrates(population, facts, spec):
        table = {"angle": spec.angle, "ratio": spec.ratio, "reference": spec.reference, "measured": spec.measured}
        return LiftingProposal(
            {"functions": [f"sin({term.ratio:g}*{term.angle} + phase)"]},
            table,
            f"{why}; every unit has a phase of its own",
        )
    return LiftingProposal({"functions": [f"{f}({term.ratio:g}*{term.angle})" for f in ("sin", "cos")]}, {}, why)


def _may_be_angle(name: str, unit: str) -> bool:
    return unit == "rad" or (unit == "" and kind_of(name) in ("angle", "position"))


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


def _lines(
    population: Population, found: Discovery | None, proposal: LiftingProposal, findings: Sequence[str], out: Path
) -> list[str]:
    """Return what people read at the terminal."""
    units, counts = population.unit_ids, {(u, c): len(keys) for u, c, keys in population.groups()}
    fewest, most = min(counts.values()), max(counts.values())
    each = f"{fewest}" if fewest == most else f"{fewest} to {most}"
    lines = [
        f"{len(units)} unit{'s' * (len(units) != 1)} ({some(units, 6)}), conditions {', '.join(population.conditions)}, {len(population.episodes)} episodes "
        f"({each} for each unit and condition), every {population.sample_period_s:g} s"
    ]
    if found is not None:
        lines += [f"  {found.reading}", *column_lines(found.columns)]
    lines += [
        f"lifting: {'; '.join(proposal.lifting['functions'])}: {proposal.why}"
        if proposal.lifting
        else f"lifting: {proposal.why}"
    ]
    lines += [f"looks wrong: {text}" for text in findings[:MOST_FINDINGS]]
    if len(findings) > MOST_FINDINGS:
        lines.append(
            f"looks wrong: {len(findings) - MOST_FINDINGS} further points, which are written at the start of the study"
        )
    until = " --until identify" if len(units) < FEWEST else ""
    return [*lines, f"study: {out}; look through it, then: kros run {out}{until}"]


def column_lines(columns: Sequence[TableColumn]) -> list[str]:
    """Return one line a column: what it is taken for, its channel and its unit of measure."""
    names = {c: f"{c.name}{f' [{c.unit}]' if c.unit else ''}" for c in columns}
    width = max(len(n) for n in names.values())
    lines = []
    for part in ColumnPart:
        for column in (c for c in columns if c.part is part):
            came = f"column {column.reference!r}" if column.reference != column.name else ""
            why = f"({column.why})" if part is ColumnPart.LEFT_OUT else ""
            lines.append(f"  {part.value:<9} {names[column]:<{width}}  {came}  {why}".rstrip())
    return lines
