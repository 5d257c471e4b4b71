"""`kros init`: look at a folder of recordings, write the study that runs on it, and say what looks wrong."""

from __future__ import annotations

import logging
import os
import re
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from ...core.errors import ConfigError, DataError, IdentificationError
from ...core.files import parse_toml
from ...core.work import Progress, Work
from ...data import Population, Role
from ...data.checks import check_population
from ...data.discovery.discover import Discovery, Wanted, discover
from ...data.discovery.roles import ColumnPart, TableColumn, is_commanded, kind_of
from ...data.readers.opening import detect_reader
from ...data.recording import some
from ...data.survey import UNLOADED, RecordingFacts, survey
from ...identify import PhaseSpec
from ...identify.calibration import calibrate
from ...identify.periodic import PeriodicTerm, periodic_term
from ...identify.presets import HARMONIC_DRIVE
from ..config import validate_config
from ..stages.read import FEWEST, open_source
from .study_text import LiftingProposal, study_text

log = logging.getLogger(__name__)
MOST_FINDINGS = 12
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
    validate_config(parse_toml(text), folder, str(out))
    out.parent.mkdir(parents=True, exist_ok=True)
    out.write_text(text, encoding="utf-8")
    return _lines(population, discovery, proposal, findings, out)


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


def _lines(
    population: Population, discovery: Discovery | None, proposal: LiftingProposal, findings: Sequence[str], out: Path
) -> list[str]:
    """Return what people read at the terminal."""
    units, counts = population.unit_ids, [len(keys) for _, _, keys in population.groups()]
    each = f"{min(counts)}" if min(counts) == max(counts) else f"{min(counts)} to {max(counts)}"
    number = f"{len(units)} unit{'s' * (len(units) != 1)} ({some(units, 6)})"
    episodes = f"{len(population.episodes)} episodes ({each} for each unit and condition)"
    period = f"every {population.sample_period_s:g} s"
    lines = [f"{number}, conditions {', '.join(population.conditions)}, {episodes}, {period}"]
    if discovery is not None:
        lines += [f"  {discovery.reading}", *column_lines(discovery.columns)]
    functions = "; ".join(proposal.lifting.get("functions", ()))
    lines.append(f"lifting: {functions}: {proposal.why}" if functions else f"lifting: {proposal.why}")
    lines += [f"looks wrong: {text}" for text in findings[:MOST_FINDINGS]]
    more = len(findings) - MOST_FINDINGS
    lines += [f"looks wrong: {more} further points, which are written at the start of the study"] if more > 0 else []
    until = " --until identify" if len(units) < FEWEST else ""
    return [*lines, f"study: {out}; read it, then run: kros run {out}{until}"]


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
