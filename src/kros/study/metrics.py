"""`metrics.json`: the machine-readable result, a stable contract.

What was not run is absent, what is unknown is null, nothing is invented.
"""

from ..core import Record, load_artifact, plain
from ..observer.sensor_gains import sensor_gains
from .config import Stage
from .engine.context import Context
from .stages import left_out

_PARTS = {"train": "train", "held_out": "test"}  # of the episodes


def collect_metrics(context: Context, until: Stage) -> Record:
    """Collect the metrics of all stages up to one."""
    done = list(Stage)[: list(Stage).index(until) + 1]
    manifest = context.store.manifest
    timing = {str(stage): manifest[stage].seconds for stage in done if stage in manifest}
    timing["total"] = sum(timing.values())
    metrics = {"schema": 1, "study": _study(context, done), "timing_s": timing, "units": _units(context, done)}
    for stage in (stage for stage in _OF_STAGES if stage in done):
        metrics |= _OF_STAGES[stage](context)
    if Stage.EVALUATE in done:
        metrics |= _evaluation(context, metrics)
    return plain(metrics)


def _study(context: Context, done: list[Stage]) -> Record:
    facts, population = context.facts, context.population
    study: Record = {
        "units": len(facts.pooled),
        "conditions": population.conditions,
        "identify_on": facts.identify_on,
        "sample_period_s": population.sample_period_s,
        "channels": {c.name: c.unit for c in population.channels},
        "measured": [c.name for c in population.channels if c.measured],
        "inputs": list(population.inputs),
        "episodes": {
            condition: {part: len(facts.keys(of, condition=condition)) for part, of in _PARTS.items()}
            for condition in population.conditions
        },
        "resolution": facts.resolution,
        "dropped": facts.dropped,
        "sensor": {name: one.model_dump(exclude_none=True) for name, one in context.config.sensor.items()},
        "alerts": facts.alerts,
    }
    if Stage.IDENTIFY in done:
        study["alpha"] = context.identified.models(context.identified.edmd_kinds[0]).alpha
    return study | ({"deployed": context.observers_record["deployed"]} if Stage.SYNTHESIZE in done else {})


def _units(context: Context, done: list[Stage]) -> list[Record]:
    facts, rows = context.facts, []
    calibration = context.calibration if Stage.CALIBRATE in done else None
    models = context.identified.models() if Stage.IDENTIFY in done else None
    for unit, group in facts.groups.items():
        row: Record = {"unit": unit, "group": group, "status": "ok"}
        if calibration is not None:
            phase = calibration.units.get(unit)
            row |= {name: getattr(phase, name, None) for name in ("phase_rad", "concentration")}
            row |= {} if phase else {"status": "not calibrated"}
        if models is not None and unit in models.unit_ids:
            row["status"] = models.status[models.index(unit)]
        elif models is not None and row["status"] == "ok":
            row["status"] = f"not identified, no recordings in {facts.identify_on}"
        rows.append(row)
    return rows


def _calibration(context: Context) -> Record:
    """What the phase of every unit belongs to; empty for a study without one."""
    if (calibration := context.calibration) is None:
        return {}
    about = {key: getattr(calibration.spec, key) for key in ("ratio", "angle", "parameter")}
    return {"calibration": about | {"lag_rad": calibration.lag_rad}}


def _models(context: Context) -> Record:
    """Models: order, functions and largest spectral radius over the pooled units."""
    entries = {}
    for name in context.identified.kinds:
        models = context.identified.models(name)
        rows = [models.index(u) for u in context.facts.pooled if u in models.unit_ids]
        radius, lifting = models.spectral_radius()[rows].max(), models.lifting
        entries[name] = {"order": lifting.n_lifted, "functions": lifting.functions, "spectral_radius_max": radius}
    return {"models": entries}


def _uncertainty(context: Context) -> Record:
    """Uncertain models by kind with the share of noise in them, and the scores of all units."""
    uncertain, store, entries = context.uncertain, context.store, dict[str, Record]()
    for name, model in uncertain.sets.items():
        orders = [model.weight.left_orders, model.weight.right_orders]
        entries[name] = {
            "form": model.form,
            "nominal": model.nominal_id,
            "peak_db": model.peak_db,
            "misfit_max": model.misfit_max,
            "weight": {"orders": orders, "cover_max": model.cover_max, "overbound_db_max": model.overbound_db_max},
        }
        if store.holds("uncertainty", name, "noise", "noise_share.json"):
            facts, _ = load_artifact(store.path("uncertainty", name, "noise"), "noise_share")
            entries[name]["noise_share"] = {key: facts[key] for key in ("median", "at_peak", "peak_hz")}
    return {"uncertainty": entries, "outliers": uncertain.scores}


def _observers(context: Context) -> Record:
    """Observers with what synthesis and certificates state, and what the deployed one reads and needs of sensors."""
    observer = context.deployed
    measured, sizes = observer.outputs, observer.about["largest_in_training"]
    deployment = {
        "measured": measured,
        "inputs": observer.inputs,
        "estimates": observer.recorded,
        "largest": {name: sizes[name] for name in (*measured, *observer.inputs)},
        "delay_samples": observer.runtime.delay,
        "parameters": {name: observer.parameters.get(name) for name in observer.lifting.parameters},
        "states": observer.lifting.n_states + observer.controller.n_states,
        "sensor": observer.about["sensor"],
        "sensor_gains": sensor_gains(observer, sizes),
    }
    return {"observers": dict(context.observers_record["facts"]), "deployment": deployment}


def _evaluation(context: Context, metrics: Record) -> Record:
    """Errors on held-out episodes, of the load, and of recorded states where truth is recorded."""
    evaluated = context.evaluation
    for name, errors in evaluated["free_run"].items():
        metrics["models"][name]["freerun_error_percent"] = errors
    metrics["observers"] |= evaluated["baselines"]
    return {key: evaluated[key] for key in ("evaluation", "intervals", "recorded", "load_torque") if key in evaluated}


_OF_STAGES = {
    Stage.CALIBRATE: _calibration,
    Stage.IDENTIFY: _models,
    Stage.QUANTIFY: _uncertainty,
    Stage.SYNTHESIZE: _observers,
    Stage.LEFT_OUT: left_out.results,
}
