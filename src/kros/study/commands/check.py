"""`kros check`: scores of new units against a finished study, the level of the innovation on them, and the verdicts."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Sequence
from enum import StrEnum
from pathlib import Path
from typing import Any
from urllib.parse import quote
from xml.etree import ElementTree

import numpy as np

from ...core.arrays import Array, Flags
from ...core.artifacts import plain
from ...core.errors import ConfigError, DataError
from ...core.work import Executor
from ...data import Population
from ...data.recording import check_population
from ...identify import ModelSet
from ...identify.identified import EpisodeFactors
from ...identify.identify import reduce_episodes
from ...observer import Observer
from ...observer.screen import screened
from ...observer.simulate import run_innovations
from ...uncertainty import OutlierModel
from ...uncertainty.outliers.population import Evidence, Recorded, score_row
from ...uncertainty.outliers.score import FEWEST_UNITS, Status
from ..config import Stage, StudyConfig
from ..engine.executors import open_executor
from ..engine.store import Store, open_finished
from .field import (
    DEPLOYED,
    FieldRecordings,
    check_channels,
    hidden_states,
    identify_on,
    load_calibration,
    open_data,
    status_counts,
    training_keys,
    unit_parameters,
)


class Verdict(StrEnum):
    """Verdict on a unit, the worst of its conditions; in the order of severity."""

    PASS = "PASS"
    UNDECIDED = "UNDECIDED"
    FAIL = "FAIL"


def with_verdict(row: dict[str, Any]) -> dict[str, Any]:
    """Return a row of scores with its verdict and the reason in words."""
    verdict = Verdict.PASS if row["status"] == Status.OK else Verdict.UNDECIDED
    return row | {"verdict": Verdict.FAIL if row["outlier"] else verdict, "reason": "; ".join(_reasons(row))}


def by_unit(rows: Sequence[dict[str, Any]]) -> dict[str, tuple[Verdict, list[str]]]:
    """Return the verdict on every unit, and the reason of every condition."""
    units: dict[str, list[dict[str, Any]]] = {}
    for row in rows:
        units.setdefault(row["unit"], []).append(row)
    return {u: (worst(of), [f"{row['condition']}: {row['reason']}" for row in of]) for u, of in units.items()}


def worst(rows: Sequence[dict[str, Any]]) -> Verdict:
    """Return the verdict of rows together: FAIL before UNDECIDED before PASS."""
    return max((Verdict(row["verdict"]) for row in rows), key=list(Verdict).index)


def verdict_lines(rows: Sequence[dict[str, Any]]) -> list[str]:
    """Return the word and the name of every unit, each followed by an indented line for every condition."""
    units = by_unit(rows).items()
    return [line for u, (v, reasons) in units for line in (f"{v:<9}  {u}", *(f"  {text}" for text in reasons))]


def require_folder(path: Path) -> None:
    """Refuse a file that cannot be written, before anything is computed."""
    if path.is_dir() or not path.absolute().parent.is_dir():
        raise ConfigError(f"--junit {path}: is not a file in an existing folder; name one.")


def junit_text(rows: Sequence[dict[str, Any]]) -> str:
    """Return JUnit XML with a test case for every unit; UNDECIDED is an error, so that a build does not pass on it."""
    units, tags = by_unit(rows), {Verdict.FAIL: "failure", Verdict.UNDECIDED: "error"}
    counts = {f"{tag}s": str(sum(v is verdict for v, _ in units.values())) for verdict, tag in tags.items()}
    suite = ElementTree.Element("testsuite", {"name": "kros check", "tests": str(len(units)), **counts})
    for unit, (verdict, reasons) in units.items():
        case = ElementTree.SubElement(suite, "testcase", classname="kros.check", name=_printable(unit))
        if verdict in tags:
            message = _printable("; ".join(reasons))
            ElementTree.SubElement(case, tags[verdict], type=verdict.value, message=message)
    ElementTree.indent(suite)
    return ElementTree.tostring(suite, "utf-8", xml_declaration=True).decode()


def _printable(text: str) -> str:
    """Return a text in which what cannot be printed is an underscore."""
    return "".join(c if c.isprintable() else "_" for c in text)


def _reasons(row: dict[str, Any]) -> list[str]:
    """Return what a verdict rests on."""
    reasons = []
    if row["score"] is not None and row["threshold"] is not None:
        reasons.append(f"score {row['score']:.2f} dB, threshold {row['threshold']:.2f} dB")
    if row["status"] == Status.NOT_ENOUGH_DATA:
        reasons.append(f"about {row['needed_s']:.3g} s of recordings are needed, found {row['recorded_s']:.3g} s")
    elif row["status"] == Status.CANNOT_TELL and "missing" not in row and row["units"] < FEWEST_UNITS:
        reasons.append(f"needs at least {FEWEST_UNITS} units to compare with, has {row['units']}")
    elif row["status"] == Status.OTHER_MOTIONS:
        less = "beyond the others, but by no more than one unit differs from motion to motion"
        reasons.append(f"{less}; repeat the motions of the study")
    elif row.get("detectable") is not None and not row["outlier"]:
        only = "only " if row["status"] == Status.CANNOT_TELL else ""
        change = f"{only}a change of gain above {row['detectable']:.2g} % would be detected"
        reasons.append(f"{change}, at {row['detectable_hz']:.3g} Hz")
    if "missing" in row:
        reasons.append(f"no score without {', '.join(row['missing'])}")
    if row.get("level_db") is not None:
        few = f", from {row['level_units']} units of which {FEWEST_UNITS} are needed"
        place = f"{abs(row['level_db']):.2f} dB {'over' if row['level_db'] > 0 else 'below'} the monitor's bound"
        reasons.append(f"innovation {place}{few if row['level_units'] < FEWEST_UNITS else ''}")
    elif "missing" in row:
        reasons.append("the deployed observer has no monitor, or no sample can be judged")
    if row["left_out"]:
        reasons.append(f"compared without {', '.join(row['left_out'])}, which is the same machine")
    reasons += [f"{count} samples {bit}" for bit, count in row.get("samples", {}).items()]
    return reasons + ([f"parameters {row['parameters']}"] if row.get("parameters") else [])


Rows = list[dict[str, Any]]
Judged = list[tuple[Array, Flags]]  # innovations, and which samples are judged


def check_units(run: Path, data: Path, workers: int = 1, same_unit: bool = False) -> Rows:
    """Identify the units of some recordings as the study did, score each against its population, and give a verdict.

    A name of a unit of the study is refused for other recordings, unless `same_unit` says it is the same machine.
    """
    stages = Stage.READ, Stage.CALIBRATE, Stage.IDENTIFY, Stage.QUANTIFY, Stage.SYNTHESIZE
    with open_finished(run, *stages) as (config, store):
        rows = scored(config, store, data, workers, same_unit)
    return [plain(with_verdict(row)) for row in sorted(rows, key=lambda r: (r["condition"], r["unit"]))]


def scored(config: StudyConfig, store: Store, data: Path, workers: int, same_unit: bool = False) -> Rows:
    """Score the units of some recordings against a run that is open."""
    pattern = re.compile("outliers/([^/]+)/outlier_model.json")
    names = [m[1] for name in sorted(store.files()) if (m := pattern.fullmatch(name))]
    observer = Observer.load(store.path(*DEPLOYED)) if store.holds(*DEPLOYED) else None
    population = open_data(config, data, hidden_states(observer) if observer else ())
    check_population(population, allow_single=True)
    watched: Rows = []
    if observer is not None:
        hidden = any(name not in population.states for name in observer.recorded)
        if hidden or observer.monitor is not None:
            watched = monitored(FieldRecordings.open(config, store, data))
        if hidden:
            return watched
        check_channels(population, observer)
    if not names:
        advice = "run the study until quantify, with at least three units"
        raise ConfigError(f"Run {store.folder}: has no outlier scores to compare with; {advice}.")
    sets = {name: ModelSet.load(store.path("models", name)) for name in names}
    known = {name: models for name, models in sets.items() if models.condition in population.conditions}
    if not known:
        modelled, there = (", ".join(c) for c in ([m.condition for m in sets.values()], population.conditions))
        both = f"the recordings have the conditions {there}, and the run has models of {modelled} alone"
        raise DataError(f"Checking {data}: {both}; name the condition, as in the study.")
    levels = {(r["unit"], r["condition"]): {k: r[k] for k in r if k.startswith("level_")} for r in watched}
    rows: Rows = []
    with open_executor(workers) as executor:
        for name, models in known.items():
            outliers = OutlierModel.load(store.path("outliers", name))
            rows += score_condition(store, population, models, outliers, executor, same_unit)
    return [row | levels.get((row["unit"], row["condition"]), {}) for row in rows]


def score_condition(
    store: Store, population: Population, models: ModelSet, outliers: OutlierModel, executor: Executor, same_unit: bool
) -> Rows:
    """Score all units that were recorded in one condition."""
    condition, training = models.condition, training_keys(population)
    everything = {unit: keys for unit, c, keys in population.groups() if c == condition}
    units = [u for u in population.unit_ids if training.get((u, condition))]
    parameters: dict[str, dict[str, float]] = {u: {} for u in units}
    if models.lifting.parameters:
        parameters = unit_parameters(population.select(units), load_calibration(store), identify_on(store))
    tasks = [(population.select([u], [condition]), everything[u], models.lifting) for u in units]
    recorded, rows = Recorded.of(factors_of(store, condition), models, outliers.freqs_hz), Rows()
    halves = recorded.halves()
    motion = None if halves is None else outliers.motion_levels(*halves)
    for unit, factor in zip(units, executor.map(reduce_episodes, tasks), strict=True):
        keys = everything[unit]
        chosen = [keys.index(k) for k in training[unit, condition]]
        evidence = Evidence.of(factor, models, parameters[unit]).part(chosen)
        known = recorded.same_recordings(factor)
        if unit in recorded.units and unit not in known and not same_unit:
            other = "the study has a unit of this name, with other recordings"
            same = "Give --same-unit if it is the same machine, which is then compared with the other units alone"
            raise DataError(f"Checking unit {unit} ({condition}): {other}. {same}; else rename it.")
        known |= {unit} & set(recorded.units)
        (response,) = recorded.response([evidence])
        level = None if recorded.same_motions(factor) else motion
        score = recorded.qualified(outliers.score(unit, response, known, level), evidence)
        row = score_row(score, condition, len(keys), float(factor.n_samples.sum()) * models.sample_period_s)
        rows.append(row | {"units": outliers.n_units, "left_out": sorted(known)})
    return rows


def factors_of(store: Store, condition: str) -> EpisodeFactors:
    """Return the factors of a run's training episodes."""
    return EpisodeFactors.load(store.path("factors", quote(condition, safe="")))


def monitored(recordings: FieldRecordings) -> Rows:
    """Return a row for every unit and condition, as `check_units` does; what needs hidden channels is unknown."""
    population, observer, rows = recordings.population, recordings.observer, Rows()
    missing = [name for name in observer.recorded if name not in population.states]
    monitor = observer.monitor
    for unit, condition, keys in population.groups():
        counts, judged, samples = Counter[str](), Judged(), 0
        for arrived in map(recordings.arriving, keys):
            samples += len(arrived.y)
            counts.update(status_counts(screened(observer, arrived.y, arrived.u).status))
            if monitor is not None:
                values = arrived.parameters(observer)
                nu, good = run_innovations(observer, arrived.y, arrived.u, values, monitor.settle)
                judged.append((nu[:, 0], good[:, 0]))
        level = None
        if monitor is not None and any(good.any() for _, good in judged):
            level = float(monitor.level(np.concatenate(monitor.in_turn(judged))).max())
        outlier = monitor is not None and monitor.units >= FEWEST_UNITS and level is not None and level > 0
        row: dict[str, Any] = dict.fromkeys(("score", "threshold", "detectable"))
        row |= {"unit": unit, "condition": condition, "outlier": outlier, "episodes": len(keys), "left_out": []}
        row |= {"status": Status.OUTLIER if outlier else Status.CANNOT_TELL, "missing": missing, "level_db": level}
        row |= {"level_rate": monitor and monitor.false_alarm_rate, "level_units": monitor and monitor.units}
        row |= {"recorded_s": samples * population.sample_period_s, "samples": counts}
        rows.append(row | {"parameters": recordings.sources.get(unit)})
    return rows
