"""Stage: every unit estimated by observers that were made without it.

The pooled units are parted into folds. For every fold the study up to its observers is made once more in a folder of its own, by the same
stages, from the recordings of all other units; what comes out runs on the test episodes of the fold's own units in all conditions. The phase of
such a unit comes from its own training episodes, on the branch of the fold's population, as that of any new machine.
"""

from __future__ import annotations

import logging
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

from ...core.artifacts import load_artifact, save_artifact
from ...core.errors import ConfigError, KrosError
from ...core.work import Progress
from ...data.population import OUTLIERS, Population
from ...identify.calibrate import calibration_keys, segments_of
from ...identify.identified import recordings_of, recordings_path
from ..config import RequireConfig, Stage, StudyConfig
from ..engine.context import Context
from ..engine.steps import Step, run_steps
from ..learning import LEARNING
from . import calibrate
from .evaluate import Outcome, UnitParameters, band_hz, error_rows, estimation, facts_of, outcomes

log = logging.getLogger(__name__)
FOLDER, KIND, FEWEST = Stage.LEFT_OUT.value, "left_out", 2


def wanted(config: StudyConfig) -> bool:
    """Tell whether a study leaves units out."""
    return config.evaluate.folds > 0


def check_folds(config: StudyConfig, population: Population) -> None:
    """Refuse more folds than there are units, or so few that one of them leaves no population to learn from."""
    parted([u.id for u in population.units if u.group != OUTLIERS], config.evaluate.folds)


def parted(units: Sequence[str], folds: int) -> list[list[str]]:
    """Return the units of every fold.

    Raises
    ------
    ConfigError
        When a fold would be empty, or leave fewer than two units to learn from.
    """
    if folds > len(units):
        raise ConfigError(f"evaluate.folds = {folds}: there are {len(units)} units to leave out; ask for at most that many folds.")
    parts = [list(units[fold::folds]) for fold in range(folds)]
    if len(units) - len(parts[0]) < FEWEST:
        raise ConfigError(
            f"evaluate.folds = {folds}: leaves {len(units) - len(parts[0])} of {len(units)} units to learn from, and a population needs {FEWEST}; "
            "ask for more folds, or record more units."
        )
    return parts


def run(context: Context) -> None:
    """Make the study once for every fold, and collect what its observers do on the units that it does not know."""
    models = context.identified.models()
    folds = parted([u for u in context.facts.pooled if u in models.unit_ids], context.config.evaluate.folds)
    for surplus in context.store.runs(FOLDER):
        if surplus.folder.name not in map(str, range(len(folds))):
            surplus.remove()
    found = [run_fold(context, number, held, len(folds)) for number, held in enumerate(folds)]
    content = {
        "folds": folds,
        "failed": {str(number): fold["failed"] for number, fold in enumerate(found) if "failed" in fold},
        "rows": [{"fold": number, **row} for number, fold in enumerate(found) for row in fold.get("rows", [])],
        "observers": facts_of_folds([fold.get("observers", {}) for fold in found]),
    }
    save_artifact(context.store.draft(FOLDER), KIND, content)


def run_fold(whole: Context, number: int, held: Sequence[str], folds: int) -> dict[str, Any]:
    """Make the study without some units, and run its observers on these; a fold that fails is a result too, with its reason."""
    progress = Fold(whole.work.progress, f"{number + 1}/{folds} ")
    context = Context(without(whole, held), whole.store.nested(FOLDER, str(number)), replace(whole.work, progress=progress))
    steps = (*LEARNING, Step(Stage.EVALUATE, partial(estimate_held, whole, held), ()))
    try:
        run_steps(context, steps, Stage.EVALUATE)
    except KrosError as error:
        log.warning("fold %d of %d: %s", number + 1, folds, error)
        return {"failed": str(error)}
    return load_artifact(context.store.path("evaluation"), KIND)[0]


def without(whole: Context, held: Sequence[str]) -> StudyConfig:
    """Return the study on the prepared recordings of all other units, which hands nothing over and so requires nothing."""
    config = whole.config
    prepared = {"source": recordings_path(whole.store.folder).absolute(), "reader": "parquet", "prepare": (), "csv": None}
    data = config.data.model_copy(update={**prepared, "identify_on": whole.facts.identify_on, "exclude": (*absent(whole), *held)})
    observer = config.observer.model_copy(update={"deployed": None})
    changes: dict[str, Any] = {"data": data, "observer": observer, "require": RequireConfig()}
    if config.uncertainty.nominal in held:
        changes["uncertainty"] = config.uncertainty.model_copy(update={"nominal": None})
    return config.model_copy(update=changes)


def absent(whole: Context) -> tuple[str, ...]:
    """Return units that the study itself excludes, where their recordings are still there."""
    return tuple(unit for unit in recordings_of(whole.store.folder).unit_ids if unit not in whole.facts.groups)


def estimate_held(whole: Context, held: Sequence[str], context: Context) -> None:
    """Run what a fold made on the test episodes of the units it does not know."""
    facts, population = whole.facts, whole.population.select(held)
    units, keys = held_parameters(whole, held, context), tuple(k for k in facts.test if k.unit in held)
    results = outcomes(context, estimation(context, population, keys, units))
    record = load_artifact(context.store.path("observers"), "observers")[0]
    band, rows = band_hz(whole), []
    for name, outcome in results.items():
        if isinstance(outcome, Outcome):
            rows += error_rows(name, outcome.summary, keys, dict.fromkeys(held, "left_out"), population.states, band, outcome.estimated)
    others = {name: facts_of(name, outcome) for name, outcome in results.items() if name not in record["facts"]}
    parameters = {unit: values for unit, values in units.items() if values}
    content = {"units": held, "parameters": parameters, "rows": rows, "observers": {**record["facts"], **others}}
    save_artifact(context.store.draft("evaluation"), KIND, content)


def held_parameters(whole: Context, held: Sequence[str], context: Context) -> UnitParameters:
    """Return the lifting parameters of units that a fold does not know, as `kros estimate` finds them."""
    calibration = calibrate.load(context)
    if calibration is None:
        return {unit: {} for unit in held}
    tasks = [(whole.population.select([u]), calibration_keys(whole.facts, u), calibration.spec) for u in held]
    segments = context.work.map("calibrate", segments_of, tasks)
    return {u: {calibration.spec.parameter: calibration.calibrate(found, u).phase_rad} for u, found in zip(held, segments, strict=True)}


def facts_of_folds(found: Sequence[dict[str, dict[str, Any]]]) -> dict[str, dict[str, Any]]:
    """Return what all folds together say about every observer.

    ``made`` and the certificates count folds: ``relift_certified`` as it runs, ``robust`` for the uncertain set. Both are None for what has no
    model and so can have none. Reasons are those that were given, without repetition.
    """
    facts = {}
    for name in dict.fromkeys(name for fold in found for name in fold):
        entries = [fold[name] for fold in found if name in fold]
        made = [e for e in entries if e.get("status") != "failed"]
        observers = [e for e in made if "relift_certified" in e]
        facts[name] = {
            "made": len(made),
            "orders": sorted({e["order"] for e in observers}),
            "relift_certified": sum(bool(e["relift_certified"]) for e in observers) if observers else None,
            "robust": sum(e.get("worst_case_h2") is not None for e in observers) if observers else None,
            "reasons": sorted({str(e[key]) for e in entries for key in ("reason", "relift_reason") if e.get(key)}),
        }
    return facts


@dataclass(frozen=True)
class Fold:
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
