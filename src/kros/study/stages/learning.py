"""The stages from recordings to observers, which are repeated where units are left out."""

from dataclasses import replace
from shutil import copyfile

from ...core import ConfigError, DataError, Names, save_artifact
from ...data import OUTLIERS, Population, read, some
from ...data.prepare import parse_steps, prepare
from ...design.synthesize import synthesize_all
from ...evaluate.over_units import draw_reserve
from ...identify import IdentifiedModels
from ...identify.calibration import calibrate
from ...identify.identify import with_models
from ...identify.presets import resolve_lifting
from ...identify.survey import Copy, survey
from ...observer.residual import FEWEST_SAMPLES
from ...uncertainty import quantify
from ..config import Stage, StudyConfig
from ..engine.context import Context, StageStep
from .diagnose import diagnose

PARQUET, ARRAYS = "parquet", "arrays"
FEWEST = 2  # units that a population is learned from


def fewest_samples(history: int = 0) -> int:
    """Return how many samples every episode needs after preparation, for a lifting with delays up to `history`."""
    return FEWEST_SAMPLES + 1 + history


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
    if unknown := [unit for unit in data.exclude if unit not in population.unit_ids]:
        known = some(population.unit_ids)
        raise ConfigError(f"data.exclude: the recordings have no unit {', '.join(unknown)}, only {known}.")
    return population.select([u for u in population.unit_ids if u not in data.exclude])


def draw(config: StudyConfig, population: Population) -> Names:
    """Return the units in reserve, drawn from those that the study does not name, by their places alone."""
    n = config.evaluate.reserve
    pooled = [u.id for u in population.units if u.group != OUTLIERS]
    free = [u for u in pooled if u not in config.load.units]
    if n and (n > len(free) or len(pooled) - n < FEWEST):
        there = f"there are {len(pooled)} units, {len(free)} not named by the study, and a population needs {FEWEST}"
        raise ConfigError(f"evaluate.reserve = {n}: {there}; reserve fewer.")
    return draw_reserve(free, n)


def run_read(context: Context) -> None:
    """Read everything once."""
    config, data, store = context.config, context.config.data, context.store
    in_place, test = data.reader == PARQUET and not data.prepare, config.split.test
    copy = None if in_place else Copy(store.draft("recordings"), store.path("recordings"))
    population = open_source(config, context.given)
    options = {"identify_on": data.identify_on, "on_nan": data.on_nan, "reserve": draw(config, population)}
    fewest = fewest_samples(resolve_lifting(config.lifting, config.calibrate, population, test).history)
    _, facts = survey(population, context.work, copy, test=test, fewest=fewest, **options)
    if in_place and facts.dropped:
        raise DataError("Dropping episodes needs a copy of the recordings; convert them again without these episodes.")
    facts = replace(facts, recordings=str(data.source)) if in_place else facts
    facts.save(store.draft("population"))


def run_calibrate(context: Context) -> None:
    """Calibrate the phase of every unit, where the lifting has one."""
    if (spec := context.phase_spec) is not None:
        calibrate(context.population, context.facts, spec, context.work).save(context.store.draft("calibration"))


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
    designs = synthesize_all(context.uncertain, *tables, context.work)
    facts = dict(designs.facts)
    for name, design in designs.designs.items():
        bounds = () if design.synthesis.worst_case_h2 is None else ("lower_bound", "gap_percent")
        norms = {key: getattr(design.synthesis, key) for key in ("status", "h2_norm", "hinf_norm", *bounds)}
        facts[name] = {**facts[name], **norms}
        observer = replace(design.observer, about={**design.observer.about, "study": config.name})
        observer.save(draft("observers", f"{name}.json"))
        design.synthesis.save(draft("synthesis", name))
        if design.certificate is not None:
            design.certificate.save(draft("observers", "relift", name))
    copyfile(draft("observers", f"{designs.deployed}.json"), draft("observers", "deployed.json"))
    content = {"names": list(designs.designs), "deployed": designs.deployed, "facts": facts}
    save_artifact(draft("observers"), "observers", content)


LEARNING = (
    StageStep(Stage.READ, run_read, ("data", "split", "evaluate.reserve")),
    StageStep(Stage.CALIBRATE, run_calibrate, ("calibrate", "lifting")),
    StageStep(Stage.IDENTIFY, run_identify, ("identify", "lifting")),
    StageStep(Stage.QUANTIFY, run_quantify, ("uncertainty",)),
    StageStep(Stage.SYNTHESIZE, run_synthesize, ("synthesis", "estimator", "sensor", "observer")),
)
