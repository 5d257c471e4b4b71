"""Scores of new units against a finished study."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from ..core.artifacts import plain
from ..core.errors import ConfigError, DataError
from ..data import Population, check_population
from ..identify import Factor, ModelSet, combine, lifted_factor
from ..observer import Observer
from ..uncertainty import OutlierModel
from .estimate import check_channels, load_calibration, open_data, training_keys, unit_parameters
from .executors import Executor, open_executor
from .pipeline import load_run
from .stages.identify import reduce_episodes
from .stages.quantify import score_row
from .store import Store


def check_units(run: Path, data: Path, workers: int = 1) -> list[dict[str, Any]]:
    """Identify the units of some recordings as the study did, and score each against the study's population.

    Returns
    -------
    list of dict
        ``unit, condition, score, threshold, outlier, frequency_hz`` and more, one row a unit and condition that the study knows.
    """
    config, store = load_run(run)
    folders = sorted(p.parent for p in store.path("outliers").glob("*/outlier_model.json"))
    if not folders:
        raise ConfigError(f"Run {run}: has no outlier scores to compare with; run the study until quantify, with at least three units.")
    population = open_data(config, data)
    check_population(population, allow_single=True)
    deployed = store.path("observers", "deployed.json")
    if deployed.exists():
        check_channels(population, Observer.load(deployed))
    rows: list[dict[str, Any]] = []
    with open_executor(workers) as executor:
        for folder in folders:
            models = ModelSet.load(store.path("models", folder.name))
            if models.condition in population.conditions:
                rows += score_condition(store, population, models, OutlierModel.load(folder), executor)
    if not rows:
        raise DataError(
            f"Checking {data}: the recordings have the conditions {', '.join(population.conditions)}, and the run knows none of them."
        )
    return [plain(row) for row in sorted(rows, key=lambda r: (r["condition"], r["unit"]))]


def score_condition(
    store: Store, population: Population, models: ModelSet, outliers: OutlierModel, executor: Executor
) -> list[dict[str, Any]]:
    """Score all units that were recorded in one condition."""
    keys = training_keys(population)
    units = [u for u in population.unit_ids if keys.get((u, models.condition))]
    parameters = (
        unit_parameters(population.select(units), load_calibration(store), _identify_on(store))
        if models.lifting.parameters
        else {u: {} for u in units}
    )
    lifting = models.lifting
    tasks = [(population.select([u], [models.condition]), keys[u, models.condition], lifting) for u in units]
    reduced = [combine(f) for f in executor.map(reduce_episodes, tasks)]
    factor = Factor(*(np.stack([getattr(f, name) for f in reduced]) for name in ("R", "peak", "n_samples")))
    values = {name: np.array([parameters[u][name] for u in units]) for name in lifting.parameters}
    matrices = models.fit(lifted_factor(factor, lifting, values, lifting).R)
    fresh = replace(models, unit_ids=tuple(units), A=matrices.A, B=matrices.B, parameters=values, status=("ok",) * len(units))
    responses = fresh.responses(outliers.freqs_hz)
    return [score_row(outliers.score(unit, response), models.condition) for unit, response in zip(units, responses, strict=True)]


def _identify_on(store: Store) -> str:
    from .context import Facts

    return Facts.load(store.path("population")).identify_on
