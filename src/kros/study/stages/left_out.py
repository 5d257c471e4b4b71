"""Stage: every unit estimated by observers that were made without it.

The pooled units are parted into folds. For every fold the study up to its observers is made once more in a folder of its own, by the same
stages, from the recordings of all other units; what comes out runs on the test episodes of the fold's own units in all conditions. The phase of
such a unit comes from its own training episodes, on the branch of the fold's population, as that of any new machine.

Units in reserve are a fold that the study itself is made without: they meet the deployed observer alone, and bound what the next unit's errors are.
"""

from __future__ import annotations

import logging
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import numpy as np

from ...core.artifacts import load_artifact, save_artifact
from ...core.errors import ConfigError, IdentificationError, KrosError
from ...core.work import Progress
from ...data.population import OUTLIERS, Population, split_episodes
from ...data.survey import RecordingFacts
from ...design.task import is_robust
from ...evaluate import next_unit_bound
from ...evaluate.next_unit import fewest_units
from ...identify.calibration import calibration_keys, segments_of
from ...identify.identified import recordings_of, recordings_path
from ...observer import Observer
from ..config import RequireConfig, Stage, StudyConfig
from ..engine.context import Context
from ..engine.steps import StageStep, run_steps
from ..learning import LEARNING
from . import calibrate
from .evaluate import (
    TestOutcome,
    UnitParameters,
    band_hz,
    error_rows,
    estimation,
    evaluate_observers,
    facts_of,
    outcomes,
)
from .read import FEWEST

log = logging.getLogger(__name__)
FOLDER, KIND = Stage.LEFT_OUT.value, "left_out"
NEXT = "next_unit"
_MEASURES = ("error_percent", "rms")
Rows = list[dict[str, Any]]


def wanted(config: StudyConfig) -> bool:
    """Tell whether a study leaves units out."""
    return config.evaluate.folds > 0 or config.evaluate.reserve > 0


def check_folds(config: StudyConfig, population: Population) -> None:
    """Refuse more folds than there are units, or so few that one of them leaves no population to learn from."""
    if config.evaluate.folds:
        parted([u.id for u in population.units if u.group != OUTLIERS], config.evaluate.folds)


def parted(units: Sequence[str], folds: int) -> list[list[str]]:
    """Return the units of every fold."""
    if folds > len(units):
        raise ConfigError(
            f"evaluate.folds = {folds}: there are {len(units)} units to leave out; ask for at most that many folds."
        )
    parts = [list(units[fold::folds]) for fold in range(folds)]
    if len(units) - len(parts[0]) < FEWEST:
        raise ConfigError(
            f"evaluate.folds = {folds}: leaves {len(units) - len(parts[0])} of {len(units)} units to learn from, and a population needs {FEWEST}; "
            "ask for more folds, or record more units."
        )
    return parts


def run(context: Context) -> None:
    """Make the study once for every fold, run the deployed observer on the units in reserve, and collect what observers do on units they do not know."""
    models, wanted_folds = context.identified.models(), context.config.evaluate.folds
    folds = parted([u for u in context.facts.pooled if u in models.unit_ids], wanted_folds) if wanted_folds else []
    for surplus in context.store.runs(FOLDER):
        if surplus.folder.name not in map(str, range(len(folds))):
            surplus.remove()
    if context.facts.reserve:
        save_artifact(context.store.draft(NEXT), NEXT, next_unit(context))
    if folds:
        run_folds(context, folds)


def results(context: Context) -> dict[str, Any]:
    """Return what the stage adds to the metrics."""
    asked = {FOLDER: context.config.evaluate.folds, NEXT: context.config.evaluate.reserve}
    return {name: load_artifact(context.store.path(name), name)[0] for name, n in asked.items() if n}


def run_folds(context: Context, folds: Sequence[Sequence[str]]) -> None:
    """Make the study once for every fold."""
    found = [run_fold(context, number, held, len(folds)) for number, held in enumerate(folds)]
    content = {
        "folds": folds,
        "errors": "empirical",  # of these units: folds share what they learn from, so nothing follows for the next one
        "failed": {str(number): fold["failed"] for number, fold in enumerate(found) if "failed" in fold},
        "rows": [{"fold": number, **row} for number, fold in enumerate(found) for row in fold.get("rows", [])],
        "observers": facts_of_folds([fold.get("observers", {}) for fold in found]),
    }
    save_artifact(context.store.draft(FOLDER), KIND, content)


def run_fold(whole: Context, number: int, held: Sequence[str], folds: int) -> dict[str, Any]:
    """Make the study without some units, and run its observers on these; a fold that fails is a result too, with its reason."""
    progress = Fold(whole.work.progress, f"{number + 1}/{folds} ")
    store = whole.store.nested(FOLDER, str(number))  # which shares results: factors of the same episodes are the same
    context = Context(without(whole, held), store, replace(whole.work, progress=progress))
    steps = (*LEARNING, StageStep(Stage.EVALUATE, partial(estimate_held, whole, held), ()))
    try:
        run_steps(context, steps, Stage.EVALUATE)
    except KrosError as error:
        log.warning("fold %d of %d: %s", number + 1, folds, error)
        return {"failed": str(error)}
    return load_artifact(context.store.path("evaluation"), KIND)[0]


def without(whole: Context, held: Sequence[str]) -> StudyConfig:
    """Return the study on the prepared recordings of all other units, which hands nothing over and so requires nothing."""
    config = whole.config
    prepared = {
        "source": recordings_path(whole.store.folder).absolute(),
        "reader": "parquet",
        "prepare": (),
        "csv": None,
    }
    data = config.data.model_copy(
        update={**prepared, "identify_on": whole.facts.identify_on, "exclude": (*absent(whole), *held)}
    )
    observer = config.observer.model_copy(update={"deployed": None})
    changes: dict[str, Any] = {"data": data, "observer": observer, "require": RequireConfig()}
    changes["evaluate"] = config.evaluate.model_copy(update={"reserve": 0})
    if config.uncertainty.nominal in held:
        changes["uncertainty"] = config.uncertainty.model_copy(update={"nominal": None})
    return config.model_copy(update=changes)


def absent(whole: Context) -> tuple[str, ...]:
    """Return units that the study itself excludes or reserves, where their recordings are still there."""
    return tuple(unit for unit in recordings_of(whole.store.folder).unit_ids if unit not in whole.facts.groups)


def estimate_held(whole: Context, held: Sequence[str], context: Context) -> None:
    """Run what a fold made on the test episodes of the units it does not know."""
    facts, population = whole.facts, whole.population.select(held)
    units, keys = held_parameters(context, population, facts), tuple(k for k in facts.test if k.unit in held)
    results = outcomes(context, estimation(context, population, keys, units))
    record = context.observers_record
    band, rows = band_hz(whole), []
    for name, outcome in results.items():
        if isinstance(outcome, TestOutcome):
            rows += error_rows(name, outcome, keys, dict.fromkeys(held, "left_out"), population.states, band)
    others = {name: facts_of(name, outcome) for name, outcome in results.items() if name not in record["facts"]}
    parameters = {unit: values for unit, values in units.items() if values}
    content = {"units": held, "parameters": parameters, "rows": rows, "observers": {**record["facts"], **others}}
    save_artifact(context.store.draft("evaluation"), KIND, content)


def held_parameters(context: Context, population: Population, facts: RecordingFacts) -> UnitParameters:
    """Return the lifting parameters of the units of a population that a study does not know, as `kros estimate` finds them."""
    calibration, held = calibrate.load(context), population.unit_ids
    if calibration is None:
        return {unit: {} for unit in held}
    tasks = [(population.select([u]), calibration_keys(facts, u), calibration.spec) for u in held]
    segments = context.work.map("calibrate", segments_of, tasks)
    return {
        u: {calibration.spec.parameter: calibration.calibrate(found, u).phase_rad}
        for u, found in zip(held, segments, strict=True)
    }


def next_unit(context: Context) -> dict[str, Any]:
    """Run the deployed observer on the units in reserve; return their errors, and what these say about the next unit in every condition."""
    config, facts = context.config.evaluate, context.facts
    deployed = context.observers_record["deployed"]
    rows, failed = reserve_rows(context, deployed)
    evaluated: Rows = context.evaluation["rows"]
    known = [r for r in evaluated if r["observer"] == deployed and r["unit"] in facts.pooled]
    hidden = [c for c in context.population.states if c not in context.population.measured] or list(
        context.population.states
    )
    content: dict[str, Any] = {
        "reserve": len(facts.reserve),
        "units": facts.reserve,
        "confidence": config.confidence,
        "observer": deployed,
    }
    found = {
        c: bounds_of(of_condition(rows, c), of_condition(known, c), hidden, config.confidence)
        for c in context.population.conditions
    }
    content |= {"jointly": True, "condition": facts.identify_on, **found.pop(facts.identify_on), "others": found}
    return content | {"rows": rows, "failed": failed}


def reserve_rows(context: Context, deployed: str) -> tuple[Rows, dict[str, str]]:
    """Return the deployed observer's errors on the test episodes of the units in reserve, infinite for one that cannot be calibrated, and the reasons."""
    whole, facts = recordings_of(context.store.folder).select(context.facts.reserve), context.facts
    splits = split_episodes(whole, context.config.split.test).values()
    train, test = (tuple(k for split in splits for k in getattr(split, part)) for part in ("train", "test"))
    facts = replace(facts, groups=dict.fromkeys(facts.reserve, ""), train=train, test=test, reserve=())
    known: UnitParameters = {}
    failed: dict[str, str] = {}
    for unit in facts.groups:
        try:
            known |= held_parameters(context, whole.select([unit]), facts)
        except IdentificationError as error:
            failed[unit] = str(error)
    keys, roles = tuple(k for k in test if k.unit in known), dict.fromkeys(facts.groups, "reserve")
    rows: Rows = []
    if keys:
        observer = Observer.load(context.store.path("observers", "deployed.json"))
        (outcome,) = evaluate_observers([observer], whole, keys, known, (), context.config.sensor)
        rows = error_rows(deployed, outcome, keys, roles, whole.states, band_hz(context))
    lost = dict.fromkeys((k.unit, k.condition) for k in test if k.unit in failed)
    base = {"observer": deployed, "role": "reserve"} | dict.fromkeys(_MEASURES, float("inf"))
    return rows + [{**base, "unit": u, "condition": c, "channel": s} for u, c in lost for s in whole.states], failed


def of_condition(rows: Rows, condition: str) -> Rows:
    """Return the rows of a condition."""
    return [row for row in rows if row["condition"] == condition]


def bounds_of(rows: Rows, known: Rows, channels: Sequence[str], confidence: float) -> dict[str, Any]:
    """Bound the next unit's errors in some channels, in percent and in RMS, all together."""
    own = {(c, m): np.array([r[m] for r in known if r["channel"] == c], float) for c in channels for m in _MEASURES}
    scale = {place: float(values.mean()) if values.size else np.nan for place, values in own.items()}
    usable = [place for place, size in scale.items() if np.isfinite(size) and size > 0]
    units, needed = list(dict.fromkeys(r["unit"] for r in rows)), fewest_units(confidence)
    if not usable:
        return {"bounds": None, "reason": "the observer has no finite error on the units that it was made from"}
    if len(units) < needed:
        return {
            "bounds": None,
            "reason": f"{len(units)} units in reserve, and a confidence of {confidence:g} needs {needed}",
        }
    errors = {(r["unit"], r["channel"], m): float(r[m]) for r in rows for m in _MEASURES}
    bound = next_unit_bound(
        [[errors[u, c, m] for c, m in usable] for u in units], [scale[p] for p in usable], confidence
    )
    if bound is None or not np.isfinite(bound).all():
        return {
            "bounds": None,
            "reason": "the observer diverges on too many of the units in reserve, or they cannot be calibrated",
        }
    values = dict(zip(usable, bound.tolist(), strict=True))
    return {"bounds": {c: {m: values.get((c, m)) for m in _MEASURES} for c in channels}, "reason": None}


def facts_of_folds(found: Sequence[dict[str, dict[str, Any]]]) -> dict[str, dict[str, Any]]:
    """Return what all folds together say about every observer."""
    facts = {}
    for name in dict.fromkeys(name for fold in found for name in fold):
        entries = [fold[name] for fold in found if name in fold]
        made = [e for e in entries if e.get("status") != "failed"]
        observers = [e for e in made if "relift_certified" in e]
        facts[name] = {
            "made": len(made),
            "orders": sorted({e["order"] for e in observers}),
            "relift_certified": sum(bool(e["relift_certified"]) for e in observers) if observers else None,
            "robust": sum(is_robust(e) for e in observers) if observers else None,
            "reasons": sorted({str(e[key]) for e in entries for key in ("reason", "relift_reason") if e.get(key)}),
        }
    return facts


@dataclass(frozen=True)
class Fold(Progress):
    """Tells a progress listener about the stages of a fold."""

    listener: Progress
    title: str

    def start(self, stage: str, total: int | None) -> None:
        """A stage of the fold begins."""
        self.listener.start(self.title + stage, total)

    def advance(self) -> None:
        """One of its steps is done."""
        self.listener.advance()

    def finish(self, stage: str, seconds: float, skipped: bool) -> None:
        """A stage of the fold is done, or was found done."""
        self.listener.finish(self.title + stage, seconds, skipped)
