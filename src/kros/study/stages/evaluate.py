"""Stage: run every model freely and every observer on all held-out episodes of all units in all conditions."""

from __future__ import annotations

import logging
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import numpy as np
import numpy.typing as npt

from ...core.artifacts import save_artifact
from ...core.errors import KrosError
from ...data import EpisodeBatch
from ...data.population import EpisodeKey, Population
from ...design.estimators import Baseline, make_difference, make_extended, make_learned
from ...design.mean_profile import make_mean_profile
from ...design.synthesize import measurement_noise
from ...design.validation import TrainingSet
from ...evaluate import TrueErrors, true_errors
from ...evaluate.errors import ErrorSummary, summarise_all
from ...evaluate.sensor import as_shown
from ...identify import ModelSet, free_run
from ...identify.presets import gearbox_band_hz
from ...observer import Observer, run_observers
from ...observer.sensor import Sensors, limits_of, sides
from ..engine.context import Context
from .disturbed import Trial, alike, make_trial, run_disturbed
from .load import run_load

log = logging.getLogger(__name__)
Array = npt.NDArray[np.float64]
UnitParameters = dict[str, dict[str, float]]
_EPISODES = 32  # side by side
_NUMBERS = 4_000_000  # of estimates that are in memory, 32 MB: memory of that size is used again, and more has to be made first


@dataclass(frozen=True, eq=False)
class TestOutcome:
    """What one model or observer did on the test episodes: errors, and trajectories of the episodes that are shown."""

    summary: ErrorSummary
    shown: list[Array]
    facts: dict[str, Any] | None = None
    estimated: tuple[int, ...] | None = None
    disturbed: Array | None = None
    true: TrueErrors | None = None


@dataclass(frozen=True, eq=False)
class Piece:
    """A piece of work and the names of its results: a list of them, or one."""

    names: tuple[str, ...]
    work: Callable[[], Any]


def evaluate_observers(
    observers: Sequence[Observer],
    population: Population,
    keys: tuple[EpisodeKey, ...],
    units: UnitParameters,
    shown: tuple[int, ...],
    sensor: Sensors,
) -> list[TestOutcome]:
    """Run observers that `alike` puts together on test episodes as the sensor shows them."""
    first = observers[0]

    def run(batch: EpisodeBatch) -> Iterator[Array]:
        y, parameters = batch.measurements(first.measured), batch.parameters if first.lifting.parameters else None
        count = max(1, _NUMBERS // batch.states.size)  # estimates of all of them may fill a memory
        groups = (observers[i : i + count] for i in range(0, len(observers), count))
        return (run_observers(group, y, batch.inputs, parameters) for group in groups)

    return _outcomes(run, population, keys, units, shown, sensor)


def evaluate_baseline(
    make: Callable[[], Baseline],
    population: Population,
    keys: tuple[EpisodeKey, ...],
    units: UnitParameters,
    shown: tuple[int, ...],
    sensor: Sensors,
    trial: Trial | None = None,
    limits: tuple[Array, Array] | None = None,
) -> TestOutcome | str:
    """Make a baseline and run it on test episodes as the sensor shows them, and on disturbed ones; the reason where it cannot be made."""
    try:
        baseline = replace(make(), limits=limits)
    except KrosError as error:
        return str(error)
    (outcome,) = _outcomes(
        lambda batch: [baseline.run(batch, batch.parameters)[None]], population, keys, units, shown, sensor
    )
    disturbed = None if trial is None else trial.errors_of_baseline(baseline)
    return replace(outcome, facts=baseline.facts, estimated=baseline.estimated, disturbed=disturbed)


def evaluate_model(
    models: ModelSet,
    population: Population,
    keys: tuple[EpisodeKey, ...],
    units: UnitParameters,
    shown: tuple[int, ...],
) -> TestOutcome:
    """Run every unit's own model freely from the true first state, with delays from the first recorded ones."""

    def run(batch: EpisodeBatch) -> list[Array]:
        rows = [models.index(k.unit) for k in batch.keys]
        parameters = batch.parameters if models.lifting.parameters else {}
        first, inputs = batch.first_states(models.lifting.history), np.swapaxes(batch.inputs, 0, 1)
        states = free_run(models.A[rows], models.B[rows], models.lifting, parameters, first, inputs)
        return [np.swapaxes(states, 0, 1)[None]]

    (outcome,) = _outcomes(run, population, keys, units, shown, {}, truths=False)
    return outcome


def _outcomes(
    run: Callable[[EpisodeBatch], Iterable[Array]],
    population: Population,
    keys: tuple[EpisodeKey, ...],
    units: UnitParameters,
    shown: tuple[int, ...],
    sensor: Sensors,
    truths: bool = True,
) -> list[TestOutcome]:
    """Return the outcomes of estimates, shape (estimate, n_samples, batch, n or more), a few at a time, some episodes after others."""
    found = []
    for start in range(0, len(keys) or 1, _EPISODES):  # none at all are refused where they are read
        batch = EpisodeBatch.read(population, keys[start : start + _EPISODES], parameters=units, truths=truths)
        batch = as_shown(batch, sensor, population.states)
        batch = replace(
            batch, states=np.ascontiguousarray(batch.states.swapaxes(1, 2)).swapaxes(1, 2)
        )  # in memory as estimates are
        own = [i - start for i in shown if 0 <= i - start < len(batch.keys)]
        found.append([outcome for estimates in run(batch) for outcome in _of_block(estimates, batch, population, own)])
    blocks = [[i for i in shown if i // _EPISODES == block] for block in range(len(found))]
    return [_joined(of_blocks, [i for block in blocks for i in block], shown) for of_blocks in zip(*found, strict=True)]


def _of_block(estimates: Array, batch: EpisodeBatch, population: Population, shown: Sequence[int]) -> list[TestOutcome]:
    n, lengths = len(population.states), batch.lengths
    summaries = summarise_all(estimates, batch.states, lengths, population.sample_period_s)
    return [
        TestOutcome(
            summary,
            [estimate[: lengths[i], i, :n].copy() for i in shown],
            true=_true(estimate[..., :n], batch, population),
        )
        for summary, estimate in zip(summaries, estimates, strict=True)
    ]


def _joined(parts: Sequence[TestOutcome], found: Sequence[int], shown: tuple[int, ...]) -> TestOutcome:
    """Put outcomes of episodes one after the other; the pieces of `found` episodes, in the order of those that are `shown`."""
    pieces = dict(zip(found, (piece for part in parts for piece in part.shown), strict=True))
    true = [part.true for part in parts if part.true is not None]
    summary = ErrorSummary.joined([part.summary for part in parts])
    return TestOutcome(summary, [pieces[i] for i in shown], true=TrueErrors.joined(true) if true else None)


def _true(signals: Array, batch: EpisodeBatch, population: Population) -> TrueErrors | None:
    if batch.truths is None:
        return None
    return true_errors(signals, batch.truths, population.true_states, batch.lengths, population.sample_period_s)


def run(context: Context) -> None:
    """Evaluate and save errors, spectra and the trajectories that are shown."""
    facts, population = context.facts, context.population
    known = context.identified.parameters
    units: UnitParameters = {u: known[u] for u in _usable(context)}
    keys = tuple(k for k in facts.test if k.unit in units)
    on = tuple(k for k in keys if k.condition == facts.identify_on)
    roles = unit_roles(context)
    shown = showcase(context, keys, roles)
    shown_on = tuple(on.index(keys[i]) for i in shown if keys[i] in on)

    observers, models = (
        load_observers(context),
        {name: context.identified.models(name) for name in context.identified.kinds},
    )
    trial = make_trial(context, keys, units, roles)
    work = estimation(context, population, keys, units, shown, trial)
    work += [
        Piece((f"free run/{m}",), partial(evaluate_model, found, population, on, units, shown_on))
        for m, found in models.items()
    ]
    results = outcomes(context, work)
    free_runs = {m: outcome for m in models if isinstance(outcome := results.pop(f"free run/{m}"), TestOutcome)}
    estimates = {name: outcome for name, outcome in results.items() if isinstance(outcome, TestOutcome)}

    band = band_hz(context)
    rows = []
    for name, outcome in estimates.items():
        rows += error_rows(name, outcome, keys, roles, population.states, band)
    free = {name: free_run_percent(o.summary, on, facts.pooled, population.states) for name, o in free_runs.items()}
    content: dict[str, Any] = {
        "rows": rows,
        "free_run": free,
        "band_hz": band,
        "roles": roles,
        "shown": [[k.unit, k.condition, k.episode] for k in (keys[i] for i in shown)],
        "baselines": {name: facts_of(name, outcome) for name, outcome in results.items() if name not in observers},
        **recorded_rows(population, keys, roles),
    }
    content |= {"observers": list(estimates), "models": list(models), "states": population.states}
    arrays = _arrays(population, keys, on, shown, shown_on, roles, estimates, free_runs)
    save_artifact(context.store.draft("evaluation"), "evaluation", content, arrays)
    disturbed = {name: (o.disturbed, o.estimated) for name, o in estimates.items() if o.disturbed is not None}
    run_disturbed(context, trial, observers, disturbed)
    run_load(context, observers)


def estimation(
    context: Context,
    population: Population,
    keys: tuple[EpisodeKey, ...],
    units: UnitParameters,
    shown: tuple[int, ...] = (),
    trial: Trial | None = None,
) -> list[Piece]:
    """Return the work of running all observers of a study, and the baselines that are made here, on some episodes."""
    makers, sensor = baseline_makers(context, population, keys), context.config.sensor
    limits = sides(limits_of(context.config.limits, context.facts.limits, population.states), population.states)
    work = [
        Piece((name,), partial(evaluate_baseline, make, population, keys, units, shown, sensor, trial, limits))
        for name, make in makers.items()
    ]
    for group in alike(load_observers(context).values()):
        names = tuple(observer.name for observer in group)
        work.append(Piece(names, partial(evaluate_observers, group, population, keys, units, shown, sensor)))
    return work


def outcomes(context: Context, work: Sequence[Piece]) -> dict[str, TestOutcome | str]:
    """Do the work; return outcomes by name, observers of the study first, in its order."""
    found: dict[str, TestOutcome | str] = {}
    for piece, result in zip(work, context.work.run("evaluate", [piece.work for piece in work]), strict=True):
        found |= dict(zip(piece.names, result if isinstance(result, list) else [result], strict=True))
    return {name: found[name] for name in dict.fromkeys((*load_observers(context), *found))}


def baseline_makers(
    context: Context, population: Population, keys: tuple[EpisodeKey, ...]
) -> dict[str, Callable[[], Baseline]]:
    """Return what makes every baseline that is no correction of a model."""
    models = {name: context.identified.models(name) for name in context.identified.kinds}
    asked, first = context.config.observer.baselines, next(iter(models.values()))
    nominal, training = context.uncertain.nominal, TrainingSet.of(context.identified, first, context.config.sensor)
    makers: dict[str, Callable[[], Baseline]] = {}
    if "ekf" in asked:
        lifted = [name for name, found in models.items() if found.lifting.functions or found.lifting.input_functions]
        for name in lifted[:1]:
            noise = measurement_noise(context.identified, models[name], context.config.sensor)
            makers[f"{name}/ekf"] = partial(make_extended, training, models[name], nominal, noise)
    if "filtered_difference" in asked:
        makers["filtered_difference"] = partial(make_difference, training, first.measured)
    whole = TrainingSet.whole(context.identified, first, context.config.sensor)
    if "mean_profile" in asked:
        makers["mean_profile"] = partial(make_mean_profile, whole, first.measured, population, keys)
    if "learned" in asked:
        makers["learned"] = partial(make_learned, whole, first.measured)
    return makers


def facts_of(name: str, result: TestOutcome | str) -> dict[str, Any]:
    """Return what the records say about a baseline that was made here."""
    if isinstance(result, TestOutcome):
        return result.facts or {}
    log.info("%s could not be made: %s", name, result)
    return {"status": "failed", "reason": result}


def _usable(context: Context) -> list[str]:
    ids = context.identified.models().unit_ids
    return [u for u in context.facts.groups if u in ids]


def band_hz(context: Context) -> tuple[float, float] | None:
    """Return the band around the gearbox frequency at the population's top speed; None for other plants."""
    spec = context.phase_spec
    if spec is None:
        return None
    first = context.identified.models()
    top_speed = float(first.input_scale[first.inputs.index(spec.reference)]) if spec.reference in first.inputs else 0.0
    return gearbox_band_hz(context.config.calibrate, context.population, top_speed)


def unit_roles(context: Context) -> dict[str, str]:
    """Return for every unit whether it is the nominal one, another of the population, or filed as an outlier."""
    nominal = context.uncertain.nominal
    pooled = context.facts.pooled
    return {
        u: "nominal" if u == nominal else ("off_nominal" if u in pooled else "outlier") for u in context.facts.groups
    }


def showcase(context: Context, keys: tuple[EpisodeKey, ...], roles: dict[str, str]) -> tuple[int, ...]:
    """Choose the episodes that are shown: nominal, worst off-nominal, and the nominal unit in every other condition."""
    facts = context.facts
    nominal = next(u for u, role in roles.items() if role == "nominal")
    worst = context.uncertain.worst_off_nominal
    wanted = [(nominal, facts.identify_on), (worst, facts.identify_on)]
    wanted += [(nominal, c) for c in sorted({k.condition for k in keys}) if c != facts.identify_on]
    firsts = [next((i for i, k in enumerate(keys) if (k.unit, k.condition) == w), None) for w in wanted]
    return tuple(dict.fromkeys(i for i in firsts if i is not None))


def error_rows(
    name: str,
    outcome: TestOutcome,
    keys: tuple[EpisodeKey, ...],
    roles: dict[str, str],
    channels: tuple[str, ...],
    band: tuple[float, float] | None,
) -> list[dict[str, Any]]:
    """Return a row for every unit, condition and channel that is estimated: the mean over the unit's test episodes."""
    summary, estimated = outcome.summary, outcome.estimated
    power = None if band is None else summary.band_power(band)
    rows = []
    for unit, condition in dict.fromkeys((k.unit, k.condition) for k in keys):
        chosen = [i for i, k in enumerate(keys) if (k.unit, k.condition) == (unit, condition)]
        for j, channel in enumerate(channels):
            if estimated is not None and j not in estimated:
                continue
            row = {"observer": name, "unit": unit, "role": roles[unit], "condition": condition, "channel": channel}
            row |= {"rms": summary.rms[chosen, j].mean(), "error_percent": summary.percent[chosen, j].mean()}
            row |= {
                f"{part}_error_percent": getattr(summary, f"{part}_percent")[chosen, j].mean()
                for part in ("start", "rest")
            }
            row |= {} if power is None else {"gearbox_band_power": power[chosen, j].mean()}
            rows.append(row | true_entry(outcome.true, chosen, j))
    return rows


def true_entry(true: TrueErrors | None, episodes: Sequence[int], state: int) -> dict[str, float]:
    """Return errors and lag against what a state really was, mean over episodes; empty where the recordings do not say."""
    if true is None or state not in true.states:
        return {}
    at = true.states.index(state)
    return {
        f"true_{what}": float(values[episodes, at].mean()) for what, values in vars(true).items() if what != "states"
    }


def recorded_rows(
    population: Population, keys: tuple[EpisodeKey, ...], roles: dict[str, str]
) -> dict[str, list[dict[str, Any]]]:
    """Return the errors of the recorded states themselves against what they really were, where the recordings say so."""
    rows: list[dict[str, Any]] = []
    for unit, condition in dict.fromkeys((k.unit, k.condition) for k in keys if population.truths):
        batch = EpisodeBatch.read(
            population, [k for k in keys if (k.unit, k.condition) == (unit, condition)], truths=True
        )
        true = _true(batch.states, batch, population)
        for state in population.true_states:
            row = {"unit": unit, "role": roles[unit], "condition": condition, "channel": population.states[state]}
            rows.append(row | true_entry(true, range(len(batch.keys)), state))
    return {"recorded": rows} if rows else {}


def free_run_percent(
    summary: ErrorSummary, keys: tuple[EpisodeKey, ...], pooled: tuple[str, ...], channels: tuple[str, ...]
) -> dict[str, dict[str, float]]:
    """Return median and worst free-run error over the pooled units, channel by channel."""
    per_unit = np.array(
        [
            summary.percent[[i for i, k in enumerate(keys) if k.unit == u]].mean(axis=0)
            for u in pooled
            if any(k.unit == u for k in keys)
        ]
    )
    return {
        c: {"median": float(np.median(per_unit[:, j])), "worst": float(per_unit[:, j].max())}
        for j, c in enumerate(channels)
    }


def load_observers(context: Context) -> dict[str, Observer]:
    """Load all observers that the synthesis stage left, in its order."""
    names = context.observers_record["names"]
    return {name: Observer.load(context.store.path("observers", f"{name}.json")) for name in names}


def _arrays(
    population: Population,
    keys: tuple[EpisodeKey, ...],
    on: tuple[EpisodeKey, ...],
    shown: tuple[int, ...],
    shown_on: tuple[int, ...],
    roles: dict[str, str],
    estimates: dict[str, TestOutcome],
    free_runs: dict[str, TestOutcome],
) -> dict[str, npt.NDArray[Any]]:
    """Collect what the figures need: shown trajectories (float32) and mean error spectra by role and condition."""
    arrays: dict[str, npt.NDArray[Any]] = {"freqs_hz": next(iter(free_runs.values())).summary.freqs_hz}
    for number, i in enumerate(shown):
        states, inputs = population.read_parts(keys[i])
        arrays[f"shown{number}/states"], arrays[f"shown{number}/inputs"] = _single(states), _single(inputs)
        for name, outcome in estimates.items():
            arrays[f"shown{number}/observer/{name}"] = _single(outcome.shown[number])
    for name, outcome in free_runs.items():
        for number, _ in enumerate(shown_on):
            arrays[f"shown{number}/model/{name}"] = _single(outcome.shown[number])
        arrays[f"spectrum/model/{name}"] = outcome.summary.spectra.mean(axis=0)
    conditions = sorted({k.condition for k in keys})
    for name, outcome in estimates.items():
        for role in ("nominal", "off_nominal"):
            for condition in conditions:
                chosen = [i for i, k in enumerate(keys) if roles[k.unit] == role and k.condition == condition]
                if chosen:
                    arrays[f"spectrum/{role}/{condition}/{name}"] = outcome.summary.spectra[chosen].mean(axis=0)
    return arrays


def _single(values: Array) -> npt.NDArray[np.float32]:
    """Halve what is stored; an estimate that diverged becomes infinite."""
    with np.errstate(over="ignore"):
        return values.astype(np.float32)
