"""Stage: every unit estimated by observers that were made without it.

The pooled units are split into folds. For every fold the same stages design observers in a separate folder, from the
recordings of all other units. These observers run on the test episodes of the fold's units in all conditions. The phase
of such a unit comes from its training episodes, on the branch of the fold's population, as that of any new machine.

Units in reserve are a fold that the study itself does not use: only the deployed observer runs on them, and its errors
bound those of the next unit.
"""

import logging
from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from itertools import compress

import numpy as np

from ...core import ConfigError, KrosError, Progress, Record, load_artifact, save_artifact
from ...data import split_episodes
from ...evaluate.over_units import fewest_units, next_unit_bound
from ...identify.calibration import unit_parameters, unit_values
from ...identify.identified import recordings_of, recordings_path
from ..config import Stage, StudyConfig
from ..engine.context import Context, StageStep, run_steps
from .evaluate import held_out, judged
from .learning import FEWEST, LEARNING

log = logging.getLogger(__name__)
FOLDER = Stage.LEFT_OUT.value
NEXT = "next_unit"
_MEASURES = ("error_percent", "rms")
Rows = list[Record]


def wanted(config: StudyConfig) -> bool:
    """Tell whether a study leaves units out."""
    return bool(config.evaluate.folds or config.evaluate.reserve)


def parted(units: Sequence[str], folds: int) -> list[list[str]]:
    """Return the units of every fold."""
    parts = [list(units[fold::folds]) for fold in range(folds)]
    if parts and (folds > len(units) or len(units) - len(parts[0]) < FEWEST):
        needs = f"of {len(units)} units each fold needs one, and leaves at least {FEWEST} to learn from"
        raise ConfigError(f"evaluate.folds = {folds}: {needs}; ask for another number, or record more units.")
    return parts


def run(context: Context) -> None:
    """Make the study once for every fold, and run the deployed observer on the units in reserve."""
    units = [u for u in context.facts.pooled if u in context.identified.models().unit_ids]
    if context.facts.reserve:
        save_artifact(context.store.draft(NEXT), NEXT, next_unit(context))
    if folds := parted(units, context.config.evaluate.folds):
        save_artifact(context.store.draft(FOLDER), FOLDER, of_folds(context, folds))


def results(context: Context) -> Record:
    """Return what the stage adds to the metrics."""
    known = [name for name in (FOLDER, NEXT) if context.store.holds(name, f"{name}.json")]
    return {name: load_artifact(context.store.path(name), name)[0] for name in known}


def of_folds(context: Context, folds: Sequence[Sequence[str]]) -> Record:
    """Make the study once for every fold; return the errors on the units that took no part in it."""
    results = []
    context.work.progress.start("left out", len(folds))
    for number, units in enumerate(folds):
        results.append(run_fold(context, number, units))
        context.work.progress.advance()
    return {
        "folds": folds,
        "errors": "empirical",  # of these units: folds share what they learn from, so nothing follows for the next one
        "failed": {str(number): fold["failed"] for number, fold in enumerate(results) if "failed" in fold},
        "rows": [{"fold": number, **row} for number, fold in enumerate(results) for row in fold.get("evaluation", [])],
        "observers": facts_of_folds([fold.get("observers", {}) for fold in results]),
    }


def run_fold(whole: Context, number: int, units: Sequence[str]) -> Record:
    """Make the study without some units, and run its observers on these; return the reason where it fails."""
    store = whole.store.nested(FOLDER, str(number))  # which shares results: factors of the same episodes are the same
    context = Context(without(whole, units), store, replace(whole.work, progress=Progress()))
    steps = (*LEARNING, StageStep(Stage.EVALUATE, partial(estimate_held, whole, units), ()))
    try:
        run_steps(context, steps, Stage.EVALUATE)
    except KrosError as error:
        log.warning("fold %d: %s", number + 1, error)
        return {"failed": str(error)}
    return load_artifact(context.store.path("evaluation"), FOLDER)[0]


def without(whole: Context, held: Sequence[str]) -> StudyConfig:
    """Return the study on the prepared recordings of all other units."""
    config = whole.config
    absent = [unit for unit in recordings_of(whole.store.folder).unit_ids if unit not in whole.facts.groups]
    changes = {
        "source": recordings_path(whole.store.folder).absolute(),
        "reader": "parquet",
        "prepare": (),
        "csv": None,
        "exclude": (*absent, *held),
        "identify_on": whole.facts.identify_on,
    }
    data = config.data.model_copy(update=changes)
    return config.model_copy(update={"data": data, "evaluate": config.evaluate.model_copy(update={"reserve": 0})})


def estimate_held(whole: Context, held: Sequence[str], context: Context) -> None:
    """Run the observers of a fold on the test episodes of the units that took no part in it."""
    facts, population = whole.facts, whole.population.select(held)
    units = unit_parameters(population, context.calibration, facts.identify_on, facts)
    keys = tuple(k for k in facts.test if k.unit in held)
    _, content = judged(context, held_out(whole, population, keys, units), dict.fromkeys(held, FOLDER))
    content["observers"] = {**context.observers_record["facts"], **content.pop("baselines")}
    save_artifact(context.store.draft("evaluation"), FOLDER, content)


def next_unit(context: Context) -> Record:
    """Run the deployed observer on the units in reserve; return what their errors say about the next unit."""
    facts, deployed = context.facts, context.observers_record["deployed"]
    population, home = recordings_of(context.store.folder).select(facts.reserve), facts.identify_on
    splits = split_episodes(population, context.config.split.test).values()
    own = replace(facts, train=tuple(key for split in splits for key in split.train))
    values, _, failed = unit_values(population, context.calibration, home, facts=own)
    rows = []
    if keys := tuple(key for split in splits for key in split.test if key.unit not in failed):
        episodes = held_out(context, population, keys, values)
        (outcome,) = episodes.observers([context.deployed])
        rows = episodes.rows(deployed, outcome, dict.fromkeys(facts.reserve, "reserve"))
    known = [r for r in context.evaluation["evaluation"] if r["observer"] == deployed and r["unit"] in facts.pooled]
    hidden = [c for c in population.states if c not in population.measured] or list(population.states)
    reserved, pooled = ([r for r in part if r["condition"] == home] for part in (rows, known))
    confidence = context.config.evaluate.confidence
    return {
        "reserve": len(facts.reserve),
        "units": facts.reserve,
        "confidence": confidence,
        "observer": deployed,
        "condition": home,
        "rows": rows,
        "failed": failed,
        **bounds_of(reserved, pooled, hidden, confidence, len(failed)),
    }


def bounds_of(rows: Rows, known: Rows, channels: Sequence[str], confidence: float, lost: int = 0) -> Record:
    """Bound the next unit's errors in some channels, in percent and in RMS, all together; lost units have no bound."""
    places = [(channel, measure) for channel in channels for measure in _MEASURES]
    errors, pooled = (
        np.array([[r[m] for r in of if r["channel"] == c] for c, m in places], float) for of in (rows, known)
    )
    errors, scale = np.pad(errors, ((0, 0), (0, lost)), constant_values=np.inf), pooled.mean(axis=1)
    usable, units = np.isfinite(scale) & (scale > 0), errors.shape[1]
    bounds = next_unit_bound(errors[usable].T, scale[usable], confidence) if usable.any() else None
    if not usable.any():
        reason = "the observer has no finite error on the units that it was made from"
    elif bounds is None:
        reason = f"{units} units in reserve, and a confidence of {confidence:g} needs {fewest_units(confidence)}"
    elif not np.isfinite(bounds).all():
        reason = "the observer diverges on too many of the units in reserve, or they cannot be calibrated"
    else:
        values = dict(zip(compress(places, usable), bounds.tolist(), strict=True))
        return {"bounds": {c: {m: values.get((c, m)) for m in _MEASURES} for c in channels}, "reason": None}
    return {"bounds": None, "reason": reason}


def facts_of_folds(folds: Sequence[dict[str, Record]]) -> dict[str, Record]:
    """Return what all folds together say about every observer."""
    facts = {}
    for name in dict.fromkeys(name for fold in folds for name in fold):
        entries = [fold[name] for fold in folds if name in fold]
        observers = [e for e in entries if e.get("status") != "failed" and "relift_certified" in e]
        facts[name] = {
            "made": sum(e.get("status") != "failed" for e in entries),
            "orders": sorted({e["order"] for e in observers}),
            "relift_certified": sum(bool(e["relift_certified"]) for e in observers) if observers else None,
            "robust": sum(e.get("worst_case_h2") is not None for e in observers) if observers else None,
        }
    return facts
