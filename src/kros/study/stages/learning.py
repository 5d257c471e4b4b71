"""The stages from recordings to observers, which are repeated where units are left out.

EDMD models of resampled episodes --> which share of the residuals finite recordings make    uncertainty/<model>/noise
residuals of all units      --> beside the weights                     uncertainty/<model>/units
the most conspicuous unit   --> against the cover of all the others    outliers/<models>/others
"""

from __future__ import annotations

import logging
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from shutil import copyfile
from typing import Any

import numpy as np

from ...core.artifacts import save_artifact
from ...core.errors import ConfigError, DataError, KrosError
from ...data import Population, read
from ...data.population import OUTLIERS
from ...data.prepare import parse_steps, prepare
from ...data.survey import Copy, check_usable, survey
from ...design.synthesize import synthesize_all
from ...evaluate.next_unit import draw_reserve
from ...identify import ModelSet
from ...identify.bootstrap import ModelSamples
from ...identify.calibration import calibrate
from ...identify.identified import IdentifiedModels
from ...identify.identify import with_models
from ...identify.presets import resolve_lifting, resolve_phase
from ...observer.residual.one_step import FEWEST_SAMPLES
from ...observer.sensor import require_measured
from ...uncertainty import Form, UncertainModel, residual
from ...uncertainty.noise import NoiseShare, noise_share
from ...uncertainty.nominal import choose_nominal
from ...uncertainty.quantify import UncertainModels, quantify
from ...uncertainty.unit_residuals import UnitResiduals, unit_residuals
from ...uncertainty.weights.cover import optimal_cover
from ..config import Stage, StudyConfig
from ..engine.context import Context, StageStep
from .resampling import resampling

PARQUET, ARRAYS = "parquet", "arrays"
FEWEST = 2  # units that a population is learned from


def open_source(config: StudyConfig, given: Population | None = None) -> Population:
    """Open the study's recordings, or take those that are given, prepared and without excluded units."""
    data = config.data
    if given is not None:
        if data.csv is not None:
            raise ConfigError("data.csv: maps columns of CSV files, and there is a population already; leave it out.")
        population = prepare(given, parse_steps(data.prepare))
    elif data.reader == ARRAYS:
        raise ConfigError("Study of arrays: they are not in the run folder; give the population to kros.run again.")
    else:
        population = read(data.source, data.reader, mapping=data.csv, prepare=data.prepare)
    unknown = [unit for unit in data.exclude if unit not in population.unit_ids]
    if unknown:
        known = ", ".join(population.unit_ids)
        raise ConfigError(f"data.exclude: the recordings have no unit {', '.join(unknown)}, only {known}.")
    return population.select([u for u in population.unit_ids if u not in data.exclude])


def draw(config: StudyConfig, population: Population) -> tuple[str, ...]:
    """Return the units in reserve, drawn from those that the study does not name, by their places alone."""
    n, named = config.evaluate.reserve, set(config.load.units)
    pooled = [u.id for u in population.units if u.group != OUTLIERS]
    free = [u for u in pooled if u not in named]
    if n and (n > len(free) or len(pooled) - n < FEWEST):
        there = f"there are {len(pooled)} units, {len(pooled) - len(free)} named by the study"
        raise ConfigError(f"evaluate.reserve = {n}: {there}, and a population needs {FEWEST}; reserve fewer.")
    return draw_reserve(free, n)


def taking_part(config: StudyConfig, population: Population) -> Population:
    """Return a population without the units in reserve."""
    reserve = draw(config, population)
    return population.select([u for u in population.unit_ids if u not in reserve])


def check_source(config: StudyConfig, population: Population, single_allowed: bool) -> None:
    """Refuse what can be refused from names alone, before anything is written."""
    check_usable(population, config.split.test, config.data.identify_on, single_allowed)
    population = taking_part(config, population)
    resolve_phase(
        config.calibrate, population, resolve_lifting(config.lifting, config.calibrate, population, config.split.test)
    )
    require_measured(config.sensor, population.measured)


def run_read(context: Context) -> None:
    """Read everything once."""
    config = context.config
    in_place, store = config.data.reader == PARQUET and not config.data.prepare, context.store
    copy = None if in_place else Copy(store.draft("recordings"), store.path("recordings"))
    population, data = open_source(config, context.given), config.data
    lifting = resolve_lifting(config.lifting, config.calibrate, population, config.split.test)
    options = {"test": config.split.test, "identify_on": data.identify_on, "on_nan": data.on_nan}
    fewest, reserve = FEWEST_SAMPLES + 1 + lifting.history, draw(config, population)
    _, facts = survey(population, context.work, copy, reserve=reserve, fewest=fewest, **options)
    if in_place and facts.dropped:
        raise DataError("Dropping episodes needs a copy of the recordings; convert them again without these episodes.")
    content = {"recordings": config.data.source if in_place else "recordings", **facts.content()}
    save_artifact(context.store.draft("population"), "facts", content)


log = logging.getLogger(__name__)


@dataclass(frozen=True)
class DiagnosticSettings:
    """Extent of what is computed for the report alone."""

    noise_points: int = 80  # frequencies at which variation and noise are compared
    points: int = 240  # frequencies of residuals
    units: int = 60  # at most, whose models are resampled


DEFAULT = DiagnosticSettings()
Result = UnitResiduals | NoiseShare
Task = tuple[Path, Callable[[], Result]]


def diagnose(context: Context, uncertain: UncertainModels) -> None:
    """Compute and save all of it; what cannot be computed is logged with its reason, and absent."""
    folder, models, sets = context.store.draft("uncertainty"), uncertain.models, uncertain.sets
    pair = models.kinds[: len(models.edmd_kinds)]  # that figures compare
    tasks: list[Task] = [
        (folder / kind / "noise", task)
        for kind in models.edmd_kinds
        if kind in sets and (task := _noise(context, kind, sets[kind])) is not None
    ]
    tasks += [(folder / k / "units", partial(beside_weights, models.models(k), sets[k])) for k in pair]
    tasks += _others(context, uncertain.scores)
    work = [partial(_attempt, place.parent.name, task) for place, task in tasks]
    for (place, _), result in zip(tasks, context.work.run("quantify (diagnose)", work), strict=True):
        if result is not None:
            result.save(place)


def _attempt(name: str, task: Callable[[], Result]) -> Result | None:
    try:
        return task()
    except KrosError as error:
        log.warning("%s: not in the report: %s", name, error)
        return None


def _noise(context: Context, name: str, uncertain: UncertainModel) -> Callable[[], NoiseShare] | None:
    """Return work that compares variation and noise over some units, the nominal one among them."""
    units, models = uncertain.unit_ids, context.identified.models(name)
    some = np.linspace(0, len(units) - 1, min(DEFAULT.units, len(units))).round().astype(int)
    chosen = [units[k] for k in np.union1d(some, [uncertain.nominal])]
    try:
        samples = resampling(context, name, chosen)
    except KrosError as error:  # single episodes
        log.info("%s: variation and noise are not separated: %s", name, error)
        return None
    return partial(_compared, samples, models, uncertain.form, chosen.index(uncertain.nominal_id))


def _compared(samples: Callable[[], ModelSamples], models: ModelSet, form: Form, nominal: int) -> NoiseShare:
    scale = models.output_scale[:, None] / models.input_scale
    freqs, dt = models.frequencies(DEFAULT.noise_points), models.sample_period_s
    return noise_share(samples(), scale, freqs, dt, form, nominal)


def beside_weights(models: ModelSet, uncertain: UncertainModel) -> UnitResiduals:
    """Return the residuals of all covered units beside the weights of a study."""
    freqs = uncertain.freqs_hz[:: max(1, len(uncertain.freqs_hz) // DEFAULT.points)]
    return unit_residuals(
        uncertain.form,
        (uncertain.nominal_id, uncertain.scaled_nominal().frequency_response(freqs)),
        dict(zip(uncertain.unit_ids, models.scaled_responses(freqs, list(uncertain.unit_ids)), strict=True)),
        uncertain.weight,
        freqs,
        models.sample_period_s,
    )


def _others(context: Context, rows: Sequence[Mapping[str, Any]]) -> list[Task]:
    """Compare the most conspicuous unit with the others, where it scores highest; for both kinds as in the paper."""
    scored = [r for r in rows if r["score"] is not None]
    top = max(scored, key=lambda r: (bool(r["outlier"]), float(r["score"])), default=None)
    if top is None:
        return []
    condition, identified, form = top["condition"], context.identified, Form(context.config.uncertainty.form)
    flagged = [r["unit"] for r in rows if r["outlier"] and r["condition"] == condition]
    outside = list(dict.fromkeys([top["unit"], *flagged]))
    sets = [identified.models(name, condition) for name in identified.edmd_kinds]
    others = [u for u, s in zip(sets[0].unit_ids, sets[0].status, strict=True) if s == "ok" and u not in outside]
    if len(others) < 2:
        return []
    responses = sets[0].scaled_responses(sets[0].frequencies(DEFAULT.points), others)
    nominal = others[choose_nominal(responses, form).index]
    places = (context.store.draft("outliers", identified.place(m.name, condition), "others") for m in sets)
    work = (partial(against_others, m, others, outside, nominal, form) for m in sets)
    return list(zip(places, work, strict=True))


def against_others(models: ModelSet, others: list[str], outside: list[str], nominal: str, form: Form) -> UnitResiduals:
    """Return the residuals of all units beside the smallest diagonal cover of `others` at every frequency."""
    freqs, row = models.frequencies(DEFAULT.points), others.index(nominal)
    everyone = [*others, *outside]
    responses = models.scaled_responses(freqs, everyone)
    cover = optimal_cover(residual(form, responses[row], responses[: len(others)]))
    units = dict(zip(everyone, responses, strict=True))
    return unit_residuals(form, (nominal, responses[row]), units, cover, freqs, models.sample_period_s, outside)


def run_calibrate(context: Context) -> None:
    """Calibrate the phase of every unit, where the lifting has one."""
    if context.phase_spec is not None:
        calibration = calibrate(context.population, context.facts, context.phase_spec, context.work)
        calibration.save(context.store.draft("calibration"))


def run_identify(context: Context) -> None:
    """Identify models of every kind in every condition."""
    base = IdentifiedModels(context.population, context.facts, context.lifting, context.calibration)
    with_models(base, context.config.identify, context.work).save_models(context.store.draft())


def run_quantify(context: Context) -> None:
    """Quantify how units differ, and what the report says beside it."""
    uncertain = quantify(context.identified, work=context.work, **dict(context.config.uncertainty))
    uncertain.save_sets(context.store.draft())
    diagnose(context, uncertain)


def run_synthesize(context: Context) -> None:
    """Design observers by every method that the study names, with their certificates, and choose the deployed one."""
    config, draft = context.config, context.store.draft
    tables = config.synthesis, config.observer, config.estimator, config.sensor
    designs = synthesize_all(context.uncertain, *tables, work=context.work)
    for name, design in designs.designs.items():
        observer = replace(design.observer, about={**design.observer.about, "study": config.name})
        observer.save(draft("observers", f"{name}.json"))
        design.synthesis.save(draft("synthesis", name))
        if design.certificate is not None:
            design.certificate.save(draft("observers", "relift", name))
    copyfile(draft("observers", f"{designs.deployed}.json"), draft("observers", "deployed.json"))
    content = {"names": list(designs.designs), "deployed": designs.deployed, "facts": designs.facts}
    save_artifact(draft("observers"), "observers", content)


LEARNING = (
    StageStep(Stage.READ, run_read, ("data", "split", "evaluate.reserve")),
    StageStep(Stage.CALIBRATE, run_calibrate, ("calibrate", "lifting")),
    StageStep(Stage.IDENTIFY, run_identify, ("identify", "lifting")),
    StageStep(Stage.QUANTIFY, run_quantify, ("uncertainty",)),
    StageStep(Stage.SYNTHESIZE, run_synthesize, ("synthesis", "estimator", "sensor", "observer")),
)
