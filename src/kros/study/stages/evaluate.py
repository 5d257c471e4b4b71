"""Stage: run every model freely and every observer on all held-out episodes of all units in all conditions."""

from __future__ import annotations

import logging
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
from typing import Any, get_args

import numpy as np

from ...core import AnyArray, Array, KrosError, Names, Record, save_artifact
from ...data import EpisodeKey
from ...design.baselines import Baseline, make_difference, make_extended, make_learned, make_mean_profile, make_trained
from ...design.synthesize import measurement_noise
from ...design.training import TrainingSet
from ...evaluate.held_out import HeldOut, Outcome, alike
from ...identify.presets import gearbox_band_hz
from ...observer import Observer
from ...observer.baselines.trained import Regressor
from ...report.run_folder import Shown
from ..engine.context import Context
from .load import run_load

log = logging.getLogger(__name__)
Pieces = dict[Names, Callable[[], Any]]  # work by the names of its results


def run(context: Context) -> None:
    """Evaluate and save errors and the trajectories that are displayed."""
    facts, population, identified = context.facts, context.population, context.identified
    units = {u: identified.parameters[u] for u in facts.groups if u in identified.models().unit_ids}
    keys = tuple(k for k in facts.test if k.unit in units)
    episodes = HeldOut(population, keys, units, sensor=context.config.sensor, band_hz=band_hz(context))
    episodes = replace(episodes, shown=showcase(context, episodes))
    at_home = replace(episodes, keys=tuple(k for k in keys if k.condition == facts.identify_on))
    observers = load_observers(context)
    work = estimation(context, episodes)
    work |= {(f"free run/{name}",): partial(at_home.models, identified.models(name)) for name in identified.kinds}
    results = outcomes(context, work)
    free_runs = {name: results.pop(f"free run/{name}") for name in identified.kinds}
    pooled = {u: "off_nominal" for u in facts.pooled} | {context.uncertain.nominal: "nominal"}
    roles = {u: pooled.get(u, "outlier") for u in facts.groups}
    content: Record = {
        "rows": [row for item in results.items() for row in episodes.rows(*item, roles)],
        "free_run": {name: free_run_percent(o, at_home, facts.pooled) for name, o in free_runs.items()},
        "band_hz": episodes.band_hz,
        "baselines": {name: outcome.facts for name, outcome in results.items() if name not in observers},
        "recorded": episodes.rows("recorded", episodes.recorded(), roles) if population.truths else [],
    }
    save_artifact(context.store.draft("evaluation"), "evaluation", content)
    for number, key in enumerate(episodes.shown):
        shown = [{n: single(o.shown[key]) for n, o in of.items() if key in o.shown} for of in (results, free_runs)]
        states, inputs = map(single, population.read_parts(key))
        one = Shown(key, population.sample_period_s, states, inputs, *shown)
        one.save(context.store.draft("evaluation", "shown", str(number)))
    run_load(context, observers)


def estimation(context: Context, episodes: HeldOut) -> Pieces:
    """Return the work of running all observers of a study, and the baselines that are made here, on some episodes."""
    makers = baseline_makers(context, episodes)
    work: Pieces = {(name,): partial(of_baseline, episodes, make) for name, make in makers.items()}
    for group in alike(load_observers(context).values()):
        work[tuple(observer.name for observer in group)] = partial(episodes.observers, group)
    return work


def of_baseline(episodes: HeldOut, make: Callable[[], Baseline]) -> Outcome:
    """Make a baseline and run it; return the reason where it cannot be made."""
    try:
        baseline = make()
    except KrosError as error:
        return Outcome(facts={"status": "failed", "reason": str(error)})
    (outcome,) = episodes.estimates(lambda *batch: [baseline.estimate(*batch)[None]], baseline.measured)
    return replace(outcome, facts=baseline.facts, estimated=baseline.estimated)


def outcomes(context: Context, work: Pieces) -> dict[str, Outcome]:
    """Do the work; return outcomes by name, observers of the study first, in its order."""
    by_name = dict[str, Outcome]()
    for names, result in zip(work, context.work.run("evaluate", work.values()), strict=True):
        by_name |= dict(zip(names, result if isinstance(result, list) else [result], strict=True))
    for name, outcome in by_name.items():
        if outcome.facts.get("status") == "failed":
            log.info("%s could not be computed: %s", name, outcome.facts["reason"])
    return {name: by_name[name] for name in dict.fromkeys((*context.observers_record["names"], *by_name))}


def baseline_makers(context: Context, episodes: HeldOut) -> dict[str, Callable[[], Baseline]]:
    """Return what makes every baseline that is no correction of a model, by name."""
    identified, sensor = context.identified, context.config.sensor
    first = identified.models()
    training, whole = TrainingSet.of(identified, first, sensor), TrainingSet.whole(identified, first, sensor)
    makers = dict[str, Callable[[], Baseline]]()
    if first.lifting.functions or first.lifting.input_functions:
        noise = measurement_noise(identified, first, sensor)
        makers[f"{first.name}/ekf"] = partial(make_extended, training, first, context.uncertain.nominal, noise)
    profile = partial(make_mean_profile, whole, first.measured, episodes.population, episodes.keys)
    makers["filtered_difference"] = partial(make_difference, training, first.measured)
    makers |= {"mean_profile": profile, "learned": partial(make_learned, whole, first.measured)}
    makers |= {kind: partial(make_trained, whole, first.measured, kind) for kind in get_args(Regressor)}
    return {n: make for n, make in makers.items() if n.split("/")[-1] in context.config.observer.baselines}


def band_hz(context: Context) -> tuple[float, float] | None:
    """Return the band around the gearbox frequency at the population's top speed; None for other plants."""
    spec = context.phase_spec
    if spec is None:
        return None
    first = context.identified.models()
    top_speed = float(first.input_scale[first.inputs.index(spec.reference)]) if spec.reference in first.inputs else 0.0
    return gearbox_band_hz(context.config.calibrate, context.population, top_speed)


def showcase(context: Context, episodes: HeldOut) -> tuple[EpisodeKey, ...]:
    """Choose the episodes to display: nominal, worst off-nominal, and the nominal unit in every other condition."""
    home, uncertain = context.facts.identify_on, context.uncertain
    others = sorted({k.condition for k in episodes.keys} - {home})
    wanted = [(uncertain.nominal, home), (uncertain.worst_off_nominal, home)]
    wanted += [(uncertain.nominal, condition) for condition in others]
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
