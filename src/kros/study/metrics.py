"""`metrics.json`: the machine-readable result, a stable contract.

What was not run is absent, what is unknown is null, nothing is invented.
"""

from __future__ import annotations

from dataclasses import asdict
from typing import Any

import numpy as np

from ..core.artifacts import load_artifact, plain, read_json
from ..data.flat_tops import FoundLimit
from ..evaluate.intervals import interval_rows
from ..observer import Observer
from ..observer.limits import Limit, limits_of
from ..synthesis.result import Synthesis
from ..uncertainty import UncertainModel, VariationAndNoise
from .config import Stage
from .engine.context import Context
from .engine.store import Store
from .stages import calibrate, left_out
from .stages.load import load_metrics


def collect_metrics(context: Context, until: Stage, total_s: float | None) -> dict[str, Any]:
    """Collect the metrics of all stages up to one."""
    done = list(Stage)[: list(Stage).index(until) + 1]
    metrics: dict[str, Any] = {"schema": 1, "study": _study(context, done), "timing_s": _timing(context, done, total_s)}
    metrics["units"] = _units(context, done)
    if Stage.CALIBRATE in done:
        metrics |= _calibration(context)
    for stage, name, collect in _SECTIONS:
        if stage in done:
            metrics[name] = collect(context)
    if Stage.SYNTHESIZE in done:
        metrics |= _deployment(context)
    if Stage.LEFT_OUT in done:
        metrics |= left_out.results(context)
    if Stage.EVALUATE in done:
        metrics |= _disturbed(context) | load_metrics(context) | _recorded(context)
    clean: dict[str, Any] = plain(metrics)
    return clean


def _study(context: Context, done: list[Stage]) -> dict[str, Any]:
    facts = context.facts
    study: dict[str, Any] = {
        "units": len(facts.pooled),
        "conditions": context.population.conditions,
        "identify_on": facts.identify_on,
        "sample_period_s": context.population.sample_period_s,
        "channels": {c.name: c.unit for c in context.population.channels},
        "measured": [c.name for c in context.population.channels if c.measured],
        "inputs": list(context.population.inputs),
        "episodes": _episodes(context),
        "resolution": facts.resolution,
        "dropped": facts.dropped,
    }
    if context.config.sensor:
        study["sensor"] = {name: own.model_dump(exclude_none=True) for name, own in context.config.sensor.items()}
    if limits := limits_of(context.config.limits, facts.limits, context.population.states):
        study["limits"] = {
            name: _limit(own, facts.limits.get(name), name in context.config.limits) for name, own in limits.items()
        }
    if facts.alerts:
        study["alerts"] = facts.alerts
    if Stage.IDENTIFY in done:
        study["alpha"] = context.identified.models(context.identified.edmd_kinds[0]).alpha
    if Stage.SYNTHESIZE in done:
        study["deployed"] = context.observers_record["deployed"]
    return study


def _episodes(context: Context) -> dict[str, dict[str, int]]:
    """Count episodes by condition, those for training and those held out."""
    keys = {"train": context.facts.keys("train"), "held_out": context.facts.keys("test")}
    return {
        condition: {part: sum(k.condition == condition for k in found) for part, found in keys.items()}
        for condition in context.population.conditions
    }


def _limit(limit: Limit, found: FoundLimit | None, declared: bool) -> dict[str, Any]:
    """Return a limit that counts, and where recordings were seen at one."""
    entry: dict[str, Any] = limit.model_dump() | {"declared": declared}
    return entry if found is None else entry | {"seen": asdict(found)}


def _timing(context: Context, done: list[Stage], total_s: float | None) -> dict[str, float]:
    timing = {stage.value: record.seconds for stage in done if (record := context.store.record(stage)) is not None}
    return timing | ({"total": total_s} if total_s is not None else {})


def _units(context: Context, done: list[Stage]) -> list[dict[str, Any]]:
    facts = context.facts
    calibration = calibrate.load(context) if Stage.CALIBRATE in done else None
    models = context.identified.models() if Stage.IDENTIFY in done else None
    rows = []
    for unit, group in facts.groups.items():
        keys = [*facts.keys("train", unit), *facts.keys("test", unit)]
        row: dict[str, Any] = {
            "unit": unit,
            "group": group,
            "conditions": list(dict.fromkeys(k.condition for k in keys)),
        }
        status = "ok"
        if calibration is not None:
            phase = calibration.units.get(unit)
            row |= {
                "phase_rad": phase.phase_rad if phase else None,
                "concentration": phase.concentration if phase else None,
            }
            status = status if phase else "not calibrated"
        if models is not None and unit in models.unit_ids:
            status = models.status[models.index(unit)]
        elif models is not None and status == "ok":
            status = f"not identified, no recordings in {facts.identify_on}"
        rows.append(row | {"status": status})
    return rows


def _calibration(context: Context) -> dict[str, Any]:
    """Return what the phase of every unit belongs to; empty for a study without one."""
    calibration = calibrate.load(context)
    if calibration is None:
        return {}
    spec = calibration.spec
    names = ("ratio", "angle", "parameter")
    return {"calibration": {name: getattr(spec, name) for name in names} | {"lag_rad": calibration.lag_rad}}


def _models(context: Context) -> dict[str, Any]:
    return {
        name: {
            "order": m.lifting.n_lifted,
            "functions": list(m.lifting.functions),
            "spectral_radius_max": _pooled_radius(context, name),
        }
        for name in context.identified.kinds
        for m in [context.identified.models(name)]
    }


def _pooled_radius(context: Context, name: str) -> float:
    models = context.identified.models(name)
    rows = [models.index(u) for u in context.facts.pooled if u in models.unit_ids]
    return float(models.spectral_radius()[rows].max())


def _uncertainty(context: Context) -> dict[str, Any]:
    store = context.store
    found = [name for name in context.identified.kinds if store.holds("uncertainty", name)]
    return {
        name: uncertainty_entry(UncertainModel.load(store.path("uncertainty", name))) | diagnostic_entry(store, name)
        for name in found
    }


def uncertainty_entry(model: UncertainModel) -> dict[str, Any]:
    """Return the metrics of one uncertain model."""
    weight = model.weight
    entry: dict[str, Any] = {
        "nominal": model.nominal_id,
        "form": model.form,
        "peak_db": model.peak_db,
        "misfit_max": model.misfit_max,
        "weight": {
            "structure": weight.structure,
            "orders": [weight.left_orders, weight.right_orders],
            "cover_max": model.cover_max,
            "overbound_db_max": model.overbound_db_max,
        },
    }
    return entry


def diagnostic_entry(store: Store, name: str) -> dict[str, Any]:
    """Return what was found out about one uncertain model beside its weights: the share of noise."""
    entry: dict[str, Any] = {}
    if store.holds("uncertainty", name, "noise"):
        noise = VariationAndNoise.load(store.path("uncertainty", name, "noise"))
        place = int(noise.residual.max(axis=0).argmax())
        shares = {
            "median": np.median(noise.noise_share),
            "at_peak": noise.noise_share[place],
            "peak_hz": noise.freqs_hz[place],
        }
        entry["noise_share"] = shares
    return entry


def _observers(context: Context) -> dict[str, Any]:
    entries: dict[str, Any] = {}
    written, certified = context.store.files(), _certified(context)
    for name, facts in context.observers_record["facts"].items():
        entry = dict(facts)
        if f"synthesis/{name}/synthesis.json" in written:
            synthesis = Synthesis.load(context.store.path("synthesis", name))
            entry |= {"status": synthesis.status, "solve_s": synthesis.solve_s}
            entry |= {key: getattr(synthesis, key) for key in ("h2_norm", "hinf_norm")}
            if synthesis.worst_case_h2 is not None:  # a Kalman filter's own optimum bounds nothing in the worst case
                entry |= {key: getattr(synthesis, key) for key in ("lower_bound", "gap_percent")}
        entries[name] = entry
    return {name: entry | certified.get(name, {}) for name, entry in entries.items()}


def _certified(context: Context) -> dict[str, dict[str, Any]]:
    """Return assumptions of certificates, and bounds for recorded signals in the channels' units of measure."""
    if not context.store.holds("observers", "relift.json"):
        return {}
    record = load_artifact(context.store.path("observers"), "relift")[0]
    bounds = {
        name: {"set_bound": dict(zip(own["states"], own["cover"], strict=True))}
        for name, own in record.get("signals", {}).items()
    }
    proofs = record.get("certificates", {})
    return {n: {"assumptions": own.get("assumptions", [])} | bounds.get(n, {}) for n, own in proofs.items()}


def _deployment(context: Context) -> dict[str, Any]:
    """Return what the deployed observer reads, estimates and needs."""
    if not context.store.holds("observers", "deployed.json"):
        return {}
    observer = Observer.load(context.store.path("observers", "deployed.json"))
    measured = [observer.lifting.states[i] for i in observer.measured]
    sizes = observer.seen
    ranges = [] if sizes is None else zip([*measured, *observer.inputs], [*sizes.measured, *sizes.inputs], strict=True)
    content = {
        "measured": measured,
        "inputs": list(observer.inputs),
        "estimates": list(observer.recorded),
        "largest": dict(ranges),
        "delay_samples": observer.runtime.delay,
        "parameters": {name: observer.parameters.get(name) for name in observer.lifting.parameters},
        "functions": list(observer.lifting.functions),
        "states": observer.lifting.n_states + observer.controller.n_states,
        "sensor": observer.about.get("sensor", {}),
    }
    return {"deployment": content}


def _observers_and_baselines(context: Context) -> dict[str, Any]:
    return {**_observers(context), **context.evaluation["baselines"]}


def _evaluation(context: Context) -> list[dict[str, Any]]:
    rows: list[dict[str, Any]] = context.evaluation["rows"]
    return rows


def _intervals(context: Context) -> list[dict[str, Any]]:
    return interval_rows(_evaluation(context))


def _disturbed(context: Context) -> dict[str, Any]:
    """Errors against severity, where the study asks for them."""
    if not context.store.holds("disturbed", "disturbed.json"):
        return {}
    content = load_artifact(context.store.path("disturbed"), "disturbed")[0]
    return {key: content[key] for key in ("robustness",) if key in content}


def _recorded(context: Context) -> dict[str, Any]:
    """Errors of recorded states against what they really were; only where the recordings say so."""
    found = context.evaluation
    return {"recorded": found["recorded"]} if "recorded" in found else {}


def _outliers(context: Context) -> list[dict[str, Any]]:
    kept = context.store.holds("outliers", "scores.json")
    rows: list[dict[str, Any]] = read_json(context.store.path("outliers", "scores.json"))["rows"] if kept else []
    return rows


def _free_run(context: Context) -> dict[str, Any]:
    models = _models(context)
    free = context.evaluation["free_run"]
    return {name: entry | {"freerun_error_percent": free[name]} for name, entry in models.items()}


_SECTIONS = (
    (Stage.IDENTIFY, "models", _models),
    (Stage.QUANTIFY, "uncertainty", _uncertainty),
    (Stage.QUANTIFY, "outliers", _outliers),
    (Stage.SYNTHESIZE, "observers", _observers),
    (Stage.EVALUATE, "models", _free_run),
    (Stage.EVALUATE, "observers", _observers_and_baselines),
    (Stage.EVALUATE, "evaluation", _evaluation),
    (Stage.EVALUATE, "intervals", _intervals),
)
