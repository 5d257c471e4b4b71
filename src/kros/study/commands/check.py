"""`kros check`: scores of new units against a finished study, the level of the innovation on them, and the verdicts."""

import logging
import re
from collections import Counter
from dataclasses import replace
from operator import itemgetter
from pathlib import Path
from urllib.parse import quote

import numpy as np

from ...core import TINY, Array, ConfigError, DataError, Mapped, plain
from ...data import EpisodeKey, Population
from ...data.prepare import with_gaps
from ...data.recording import GroupWatch, check_population, digest_of, refuse_copies, title
from ...evaluate.held_out import HeldOut
from ...identify import ModelSet
from ...identify.calibration import Values, unit_parameters
from ...identify.factors import reduce_episodes
from ...identify.identified import EpisodeFactors
from ...identify.likeness import course, odd
from ...observer import run_innovations, screened
from ...report.unit_verdicts import Rows, with_verdict
from ...uncertainty import OutlierModel
from ...uncertainty.outliers.population import Evidence, Recorded, score_row
from ...uncertainty.outliers.score import FEWEST_UNITS, Status
from ..engine.context import Context, open_finished
from ..engine.executors import open_executor
from ..engine.store import DEPLOYED
from .field import FieldRecordings, check_channels, hidden_states, open_data, status_counts

log = logging.getLogger(__name__)


def check_units(run: Path, data: Path, workers: int, same_unit: bool) -> Rows:
    """Identify the units of some recordings as the study did, score each against its population, and give a verdict.

    A name of a unit of the study is refused for other recordings, unless `same_unit` says it is the same machine.
    """
    with open_finished(run) as context:
        return verdicts(context, data, workers, same_unit)


def verdicts(context: Context, data: Path, workers: int = 1, same_unit: bool = False) -> Rows:
    """Do the same in a run that is open."""
    rows = scored(context, data, workers, same_unit)
    return [with_verdict(plain(row)) for row in sorted(rows, key=itemgetter("condition", "unit"))]


def scored(context: Context, data: Path, workers: int, same_unit: bool) -> Rows:
    """Score the units of some recordings."""
    store = context.store
    names = re.findall("^outliers/([^/]+)/outlier_model.json$", "\n".join(sorted(store.files())), re.MULTILINE)
    observer = context.deployed if store.holds(*DEPLOYED) else None
    population = open_data(context.config, data, hidden_states(observer) if observer else ())
    check_population(population, allow_single=True)
    check_recordings(with_gaps(population))
    if observer is not None:
        if any(name not in population.states for name in observer.recorded):
            return monitored(FieldRecordings.open(context, data))
        check_channels(population, observer)
    values = unit_parameters(population, context.calibration, context.facts.identify_on)
    errors = errors_beside_bounds(context, population, values) if observer else {}
    if not names:
        advice = "run the study until quantify, with at least three units"
        raise ConfigError(f"Run {store.folder}: has no outlier scores to compare with; {advice}.")
    sets = {name: ModelSet.load(store.path("models", name)) for name in names}
    known = {name: models for name, models in sets.items() if models.condition in population.conditions}
    if not known:
        modelled, there = (", ".join(c) for c in ([m.condition for m in sets.values()], population.conditions))
        problem = f"the recordings have the conditions {there}, and the run has models of {modelled} alone"
        raise DataError(f"Checking {data}: {problem}; name the condition, as in the study.")
    rows = []
    with open_executor(workers) as mapped:
        for name, models in known.items():
            outliers = OutlierModel.load(store.path("outliers", name))
            factors = EpisodeFactors.load(store.path("factors", quote(models.condition, safe="")))
            recorded = Recorded.of(factors, models, outliers.freqs_hz)
            rows += score_condition(recorded, outliers, population, values, mapped, same_unit)
    for row in rows:
        if beside := errors.get((row["unit"], row["condition"])):
            row["error"] = max(beside, key=itemgetter("ratio"))
            gains = {e["state"]: e["gain_percent"] for e in beside}
            row["detectable"] = {s: min(p, gains.get(s, np.inf)) for s, p in row["detectable"].items()}
    return rows


def check_recordings(population: Population) -> None:
    """Refuse copies as a study does, and warn of all else that it refuses or warns of."""
    seen, alerts = dict[EpisodeKey, tuple[str, Array]](), list[str]()
    for _, _, keys in population.groups():
        watch = GroupWatch(population.columns)
        for key in keys:
            values = population.source(key)
            watch.add(key, values)
            seen[key] = digest_of(values), course(values)[:, : len(population.states)]
        alerts += watch.problems()
    refuse_copies((key, digest) for key, (digest, _) in seen.items())
    alerts += odd([title(key) for key in seen], population.states, np.array([of for _, of in seen.values()]))
    for alert in alerts:
        log.warning("%s", alert)


def errors_beside_bounds(context: Context, population: Population, values: Values) -> dict[tuple[str, str], Rows]:
    """Return errors of the deployed observer in hidden states beside its bounds, by unit, in the models' condition.

    A change of a state's gain adds a part of the state to the error. That part may be in the error already.
    """
    home, observer = context.facts.identify_on, context.deployed
    bounds = context.observers_record["facts"].get(observer.name, {}).get("set_bound", {})
    states = [name for name in hidden_states(observer) if bounds.get(name)]
    if home not in population.conditions or not states:
        return {}
    episodes = HeldOut(population, population.keys(condition=home), values, sensor=context.config.sensor)
    errors = dict[tuple[str, str], Rows]()
    for place, keys in episodes.groups.items():
        (outcome,) = replace(episodes, keys=tuple(keys), shown=tuple(keys)).observers([observer])
        parts = np.mean([_parts(outcome.shown[key], population.read(key)) for key in keys], axis=0)
        for name in states:
            i, bound = population.states.index(name), bounds[name]
            (size, along, apart), rms = parts[:, i], float(np.mean([outcome.errors[key][i]["rms"] for key in keys]))
            gain = float((abs(along) + np.sqrt(max(bound**2 - apart**2, 0.0))) / max(size, TINY))
            errors.setdefault(place, []).append(
                {
                    "state": name,
                    "rms": rms,
                    "bound": bound,
                    "ratio": rms / bound,
                    "unit": population.channels[i].unit,
                    "gain_percent": 100 * gain,
                }
            )
    return errors


def _parts(estimate: Array, recorded: Array) -> Array:
    """Return sizes of states about their means, and of the error along with them and apart from them, (3, n)."""
    recorded = recorded[:, : estimate.shape[1]]
    with np.errstate(over="ignore", invalid="ignore"):
        moves, error = recorded - recorded.mean(axis=0), recorded - estimate
        size = moves.std(axis=0)
        along = (error * moves).mean(axis=0) / np.maximum(size, TINY)
        return np.stack([size, along, np.sqrt(np.maximum((error**2).mean(axis=0) - along**2, 0.0))])


def score_condition(
    recorded: Recorded,
    outliers: OutlierModel,
    population: Population,
    values: Values,
    mapped: Mapped,
    same_unit: bool,
) -> Rows:
    """Score all units that were recorded in one condition."""
    models, rows = recorded.models, []
    condition, halves = models.condition, recorded.halves()
    everything = {unit: keys for unit, c, keys in population.groups() if c == condition}
    tasks = [(population.select([u], [condition]), keys, models.lifting) for u, keys in everything.items()]
    motion = None if halves is None else outliers.motion_levels(*halves)
    for (unit, keys), factor in zip(everything.items(), mapped(reduce_episodes, tasks), strict=True):
        evidence = Evidence.of(factor, models, values[unit])
        known = recorded.same_recordings(factor)
        if unit in recorded.units and unit not in known and not same_unit:
            other = "the study has a unit of this name, with other recordings"
            same = "Give --same-unit if it is the same machine, which is then compared with the other units alone"
            raise DataError(f"Checking unit {unit} ({condition}): {other}. {same}; else rename it.")
        for alert in recorded.unlike(unit, list(map(title, keys)), factor):
            log.warning("%s", alert)
        known |= {unit} & set(recorded.units)
        (response,) = recorded.response([evidence])
        level = None if recorded.same_motions(factor) else motion
        score = recorded.qualified(outliers.score(unit, response, known, level), evidence)
        row = score_row(score, models, len(keys), evidence.n_samples * models.sample_period_s)
        rows.append(row | {"units": len(set(outliers.unit_ids) - known), "left_out": sorted(known)})
    return rows


def monitored(recordings: FieldRecordings) -> Rows:
    """Return a row for every unit and condition without recorded hidden channels: the monitor's level decides."""
    population, observer, rows = recordings.population, recordings.observer, []
    missing = [name for name in observer.recorded if name not in population.states]
    monitor, units = observer.monitor, observer.monitor.units if observer.monitor else 0
    for unit, condition, keys in population.groups():
        counts, judged, samples = Counter[str](), [], 0  # innovations, and where they count
        for arrived in map(recordings.arriving, keys):
            samples += len(arrived.y)
            counts.update(status_counts(screened(observer, arrived.y, arrived.u).status))
            if monitor is not None:
                nu, good = run_innovations(observer, arrived.y, arrived.u, arrived.parameters, monitor.settle)
                judged.append((nu[:, 0], good[:, 0]))
        level = None
        if monitor is not None and any(good.any() for _, good in judged):
            level = float(monitor.level(np.concatenate(monitor.in_turn(judged))).max())
        outlier = units >= FEWEST_UNITS and level is not None and level > 0
        rows.append(
            {
                **dict.fromkeys(("score", "threshold", "detectable")),
                "unit": unit,
                "condition": condition,
                "outlier": outlier,
                "episodes": len(keys),
                "left_out": [],
                "status": Status.OUTLIER if outlier else Status.CANNOT_TELL,
                "missing": missing,
                "level_db": level,
                "level_units": units,
                "recorded_s": samples * population.sample_period_s,
                "samples": counts,
                "parameters": recordings.sources.get(unit),
            }
        )
    return rows
