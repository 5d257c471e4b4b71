"""Stage: run every model freely and every observer on all held-out episodes of all units in all conditions."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from functools import partial
from itertools import chain
from typing import get_args

import numpy as np

from ...core import AnyArray, Array, KrosError, Record, save_artifact
from ...data import Population
from ...data.population import Keys
from ...design.baselines import Baseline, make_difference, make_extended, make_learned, make_mean_profile, make_trained
from ...design.synthesize import measurement_noise
from ...design.training import TrainingSet
from ...evaluate.held_out import HeldOut, Outcome, alike
from ...evaluate.over_units import interval_rows
from ...identify.calibration import Values
from ...identify.presets import gearbox_band_hz
from ...observer import Observer
from ...observer.baselines.learned import Regressor
from ...report.run_folder import Shown
from ..engine.context import Context
from .load import run_load


def run(context: Context) -> None:
    """Evaluate and save errors and the trajectories that are displayed."""
    facts, population, identified = context.facts, context.population, context.identified
    units = {u: identified.parameters[u] for u in facts.groups if u in identified.models().unit_ids}
    keys = tuple(k for k in facts.test if k.unit in units)
    episodes = held_out(context, population, keys, units)
    episodes = replace(episodes, shown=showcase(context, episodes))
    at_home = replace(episodes, keys=tuple(k for k in keys if k.condition == facts.identify_on))
    models = [partial(at_home.models, identified.models(name)) for name in identified.kinds]
    simulated = context.work.begin("evaluate", models)
    roles = dict.fromkeys(facts.groups, "outlier") | dict.fromkeys(facts.pooled, "off_nominal")
    roles[context.uncertain.nominal] = "nominal"
    results, content = judged(context, episodes, roles)
    free_runs = dict(zip(identified.kinds, simulated(), strict=True))
    content |= {
        "free_run": {name: free_run_percent(o, at_home, facts.pooled) for name, o in free_runs.items()},
        "band_hz": episodes.band_hz,
        "intervals": interval_rows(content["evaluation"]),
    }
    content |= run_load(context, load_observers(context))
    if population.truths:
        content["recorded"] = episodes.rows("recorded", episodes.recorded(), roles)
    save_artifact(context.store.draft("evaluation"), "evaluation", content)
    for number, key in enumerate(episodes.shown):
        shown = [{n: single(o.shown[key]) for n, o in of.items() if key in o.shown} for of in (results, free_runs)]
        states, inputs = map(single, population.read_parts(key))
        place = context.store.draft("evaluation", "shown", str(number))
        Shown(key, population.sample_period_s, states, inputs, *shown).save(place)


def judged(context: Context, episodes: HeldOut, roles: Mapping[str, str]) -> tuple[dict[str, Outcome], Record]:
    """Run the observers of a study, and baselines that are made here, on some episodes; return errors and facts."""
    groups, makers = alike(load_observers(context).values()), baseline_makers(context, episodes)
    work: list[Callable[[], list[Outcome]]] = [partial(of_baseline, episodes, make) for make in makers.values()]
    work += [partial(episodes.observers, group) for group in groups]
    names = [*makers, *(observer.name for group in groups for observer in group)]
    outcomes = dict(zip(names, chain.from_iterable(context.work.run("evaluate", work)), strict=True))
    outcomes = {name: outcomes[name] for name in (*context.observers_record["names"], *makers)}
    rows = [row for item in outcomes.items() for row in episodes.rows(*item, roles)]
    return outcomes, {"evaluation": rows, "baselines": {name: outcomes[name].facts for name in makers}}


def of_baseline(episodes: HeldOut, make: Callable[[], Baseline]) -> list[Outcome]:
    """Make a baseline and run it; return the reason where it cannot be made."""
    try:
        baseline = make()
    except KrosError as error:
        return [Outcome(facts={"status": "failed", "reason": str(error)})]
    outcomes = episodes.estimates(lambda *batch: [baseline.estimate(*batch)], baseline.measured)
    return [replace(outcome, facts=baseline.facts, estimated=baseline.estimated) for outcome in outcomes]


def baseline_makers(context: Context, episodes: HeldOut) -> dict[str, Callable[[], Baseline]]:
    """Return what makes every baseline that is no correction of a model, by name."""
    identified, sensor = context.identified, context.config.sensor
    first = identified.models()
    training, whole = TrainingSet.of(identified, first, sensor), TrainingSet.whole(identified, first, sensor)
    makers = dict[str, Callable[[], Baseline]]()
    if first.lifting.functions or first.lifting.input_functions:
        noise = measurement_noise(identified, first, sensor)
        makers[f"{first.name}/ekf"] = partial(make_extended, training, first, context.uncertain.nominal, noise)
    makers |= {
        "filtered_difference": partial(make_difference, training, first.measured),
        "mean_profile": partial(make_mean_profile, whole, first.measured, episodes.population, episodes.keys),
        "learned": partial(make_learned, whole, first.measured),
        **{kind: partial(make_trained, whole, first.measured, kind) for kind in get_args(Regressor)},
    }
    return {n: make for n, make in makers.items() if n.split("/")[-1] in context.config.observer.baselines}


def held_out(context: Context, population: Population, keys: Keys, units: Values) -> HeldOut:
    """Return episodes as sensors show them, and the band of a gearbox at the top speed of the study's population."""
    config, spec, band_hz = context.config, context.phase_spec, None
    if spec is not None:
        band_hz = gearbox_band_hz(config.calibrate, context.population, context.identified.sizes[spec.reference])
    return HeldOut(population, keys, units, sensor=config.sensor, band_hz=band_hz)


def showcase(context: Context, episodes: HeldOut) -> Keys:
    """Choose the episodes to display: nominal, worst off-nominal, and the nominal unit in every other condition."""
    home, uncertain = context.facts.identify_on, context.uncertain
    wanted = [(uncertain.nominal, home), (uncertain.worst_off_nominal, home)]
    wanted += [(uncertain.nominal, condition) for condition in sorted({k.condition for k in episodes.keys} - {home})]
    groups = episodes.groups
    return tuple(groups[group][0] for group in dict.fromkeys(wanted) if group in groups)


def free_run_percent(outcome: Outcome, episodes: HeldOut, pooled: Sequence[str]) -> dict[str, dict[str, float]]:
    """Return median and worst free-run error over the pooled units, channel by channel."""
    rows = [row for row in episodes.rows("", outcome, dict.fromkeys(episodes.parameters, "")) if row["unit"] in pooled]
    errors = {c: [r["error_percent"] for r in rows if r["channel"] == c] for c in episodes.population.states}
    return {c: {"median": float(np.median(of)), "worst": max(of)} for c, of in errors.items()}


def load_observers(context: Context) -> dict[str, Observer]:
    """Load all observers that the synthesis stage left, in its order."""
    names = context.observers_record["names"]
    return {name: Observer.load(context.store.path("observers", f"{name}.json")) for name in names}


def single(values: Array) -> AnyArray:
    """Return signals for figures, in single precision; an estimate that diverged becomes infinite."""
    with np.errstate(over="ignore"):
        return values.astype(np.float32)
