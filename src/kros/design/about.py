"""What is written into the file of an observer for those who put it into machines."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict
from importlib.metadata import version
from typing import Any

from ..core.artifacts import plain
from ..data.population import scaling_of
from ..identify.identified import IdentifiedModels
from ..observer import Observer, ReliftCertificate, Sensor
from .task import DesignTask

_SIGNALS = {
    "set_certified": "certified",
    "set_reason": "reason",
    "set_bound_percent": "bound_percent",
    "set_outside": "outside",
}
_LOSSES = {
    "dropout_rate": "rate",
    "dropout_certified": "certified",
    "dropout_mean_square_gain": "mean_square_gain",
    "dropout_reason": "reason",
}


def about(
    task: DesignTask,
    identified: IdentifiedModels,
    observer: Observer,
    certificate: ReliftCertificate,
    facts: Mapping[str, Any],
) -> dict[str, Any]:
    """Return the object ``about`` of an observer's file, in the recordings' units."""
    population, known, calibration = identified.population, identified.facts, identified.calibration
    as_it_runs = {"certified": certificate.certified, "reason": certificate.reason, "gain": certificate.gain}
    found: dict[str, Any] = {
        "kros": version("kros"),
        "units_of_measure": {c.name: c.unit for c in population.channels if c.name in identified.sizes},
        "largest_in_training": identified.sizes,
        "columns": {
            name: asdict(scaling_of(population.scaling, name)) for name in (*population.states, *population.inputs)
        },
        "sensor": {name: _sensor(observer, name, known.resolution[name]) for name in population.measured},
        "trained_on": {
            "units": len(set(known.pooled) & set(task.models.unit_ids)),
            "conditions": identified.conditions,
            "identify_on": known.identify_on,
        },
        "as_it_runs": {**as_it_runs, "operating_box": certificate.box, "assumptions": certificate.assumptions},
        "uncertain_set": {"worst_case_h2": facts.get("worst_case_h2"), "reason": facts.get("reason") or ""},
    }
    if calibration is not None and calibration.spec.parameter in observer.lifting.parameters:
        spec = calibration.spec
        found["parameters"] = {
            spec.parameter: {
                **{name: getattr(spec, name) for name in ("angle", "ratio", "reference", "measured")},
                "lag_rad": calibration.lag_rad,
            }
        }
    for key, names in (("recorded_signals", _SIGNALS), ("losses", _LOSSES)):
        own = {name: facts[fact] for fact, name in names.items() if fact in facts}
        found |= {key: own} if own else {}
    content: dict[str, Any] = plain(found)
    return content


def _sensor(observer: Observer, name: str, resolution: float) -> dict[str, Any]:
    told = observer.sensor.get(name, Sensor())
    return told.model_copy(update={"resolution": max(told.resolution or 0.0, resolution)}).model_dump()
