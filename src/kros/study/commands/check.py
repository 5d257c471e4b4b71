"""Scores of new units against a finished study."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any
from urllib.parse import quote

from ...core.artifacts import plain
from ...core.errors import ConfigError, DataError
from ...core.work import Executor
from ...data import Population
from ...data.checks import check_population
from ...identify import ModelSet
from ...identify.identified import EpisodeFactors
from ...identify.identify import reduce_episodes
from ...observer import Observer
from ...uncertainty import OutlierModel
from ...uncertainty.outliers.population import score_row
from ...uncertainty.outliers.recorded import Evidence, Recorded
from ..config import Stage, StudyConfig
from ..engine.executors import open_executor
from ..engine.run_folder import open_finished
from ..engine.store import Store
from .field import FieldRecordings
from .innovation import monitored
from .recordings import (
    check_channels,
    hidden_states,
    identify_on,
    load_calibration,
    open_data,
    training_keys,
    unit_parameters,
)
from .verdict import with_verdict


def check_units(run: Path, data: Path, workers: int = 1, same_unit: bool = False) -> list[dict[str, Any]]:
    """Identify the units of some recordings as the study did, score each against its population, and give a verdict.

    A name of a unit of the study is refused for other recordings, unless `same_unit` says it is the same machine.
    """
    with open_finished(run, Stage.READ, Stage.CALIBRATE, Stage.IDENTIFY, Stage.QUANTIFY, Stage.SYNTHESIZE) as (
        config,
        store,
    ):
        return scored(config, store, data, workers, same_unit)


def scored(
    config: StudyConfig, store: Store, data: Path, workers: int, same_unit: bool = False
) -> list[dict[str, Any]]:
    """Score the units of some recordings against a run that is open."""
    pattern = re.compile("outliers/([^/]+)/outlier_model.json")
    folders = [store.path("outliers", m[1]) for name in sorted(store.files()) if (m := pattern.fullmatch(name))]
    deployed = ("observers", "deployed.json")
    observer = Observer.load(store.path(*deployed)) if store.holds(*deployed) else None
    population = open_data(config, data, hidden_states(observer) if observer else ())
    check_population(population, allow_single=True)
    watched: list[dict[str, Any]] = []
    if observer is not None:
        check_channels(population, observer, field_recordings=True)
        hidden = any(name not in population.states for name in observer.recorded)
        recordings = FieldRecordings.open(config, store, data)
        watched = monitored(recordings) if hidden or observer.monitor is not None else []
        if hidden:
            return in_order(watched)
        check_channels(population, observer)
    if not folders:
        advice = "run the study until quantify, with at least three units"
        raise ConfigError(f"Run {store.folder}: has no outlier scores to compare with; {advice}.")
    rows: list[dict[str, Any]] = []
    with open_executor(workers) as executor:
        for folder in folders:
            models = ModelSet.load(store.path("models", folder.name))
            if models.condition in population.conditions:
                rows += score_condition(store, population, models, OutlierModel.load(folder), executor, same_unit)
    if not rows:
        modelled = ", ".join(ModelSet.load(store.path("models", folder.name)).condition for folder in folders)
        recorded = f"the recordings have the conditions {', '.join(population.conditions)}"
        both = f"{recorded}, and the run has models of {modelled} alone"
        raise DataError(f"Checking {data}: {both}; name the condition, as in the study.")
    names = ("level_db", "level_rate", "level_units", "bands_db")
    levels = {(row["unit"], row["condition"]): {key: row[key] for key in names} for row in watched}
    return in_order([row | levels.get((row["unit"], row["condition"]), {}) for row in rows])


def in_order(rows: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """Return rows of scores by condition and unit, with their verdicts, in JSON's types."""
    return [plain(with_verdict(row)) for row in sorted(rows, key=lambda r: (r["condition"], r["unit"]))]


def score_condition(
    store: Store, population: Population, models: ModelSet, outliers: OutlierModel, executor: Executor, same_unit: bool
) -> list[dict[str, Any]]:
    """Score all units that were recorded in one condition."""
    training, everything = training_keys(population), {(u, c): keys for u, c, keys in population.groups()}
    units = [u for u in population.unit_ids if training.get((u, models.condition))]
    parameters = (
        unit_parameters(population.select(units), load_calibration(store), identify_on(store))
        if models.lifting.parameters
        else {u: {} for u in units}
    )
    tasks = [
        (population.select([u], [models.condition]), everything[u, models.condition], models.lifting) for u in units
    ]
    recorded, rows = Recorded.of(factors_of(store, models.condition), models, outliers.freqs_hz), []
    halves = recorded.halves()
    motion = None if halves is None else outliers.motion_levels(*halves)
    for unit, factor in zip(units, executor.map(reduce_episodes, tasks), strict=True):
        keys, used = everything[unit, models.condition], training[unit, models.condition]
        evidence = Evidence.of(factor, models, parameters[unit]).part([keys.index(k) for k in used])
        known = recorded.same_recordings(factor)
        if unit in recorded.units and unit not in known and not same_unit:
            known_name = "the study has a unit of this name, with other recordings"
            same = "Give --same-unit if it is the same machine, which is then compared with the other units alone"
            raise DataError(f"Checking unit {unit} ({models.condition}): {known_name}. {same}; else rename it.")
        known |= {unit} & set(recorded.units)
        (response,) = recorded.response([evidence])
        score = recorded.qualified(
            outliers.score(unit, response, known, None if recorded.same_motions(factor) else motion), evidence
        )
        seconds = float(factor.n_samples.sum()) * models.sample_period_s
        row = score_row(score, models.condition, len(keys), seconds)
        rows.append(row | {"units": outliers.n_units, "left_out": sorted(known)})
    return rows


def factors_of(store: Store, condition: str) -> EpisodeFactors:
    """Return the factors of a run's training episodes."""
    return EpisodeFactors.load(store.path("factors", quote(condition, safe="")))
