"""What is written into the file of an observer for those who put it into machines."""

from __future__ import annotations

from dataclasses import asdict
from importlib.metadata import version
from typing import Any

from ..core.artifacts import plain
from ..data.population import scaling_of
from ..identify.identified import IdentifiedModels
from ..observer import Sensor
from .task import Design, DesignTask

_SIGNALS = {
    "set_certified": "certified",
    "set_reason": "reason",
    "set_bound_percent": "bound_percent",
    "set_outside": "outside",
}


def about(task: DesignTask, identified: IdentifiedModels, design: Design) -> dict[str, Any]:
    """Return the object ``about`` of an observer's file, in the recordings' units."""
    population, known, calibration = identified.population, identified.facts, identified.calibration
    observer, certificate, facts = design.observer, design.certificate, design.facts
    assert certificate is not None
    proof = {name: getattr(certificate, name) for name in ("certified", "reason", "gain", "assumptions")}
    trained = {"units": len(set(known.pooled) & set(task.models.unit_ids)), "conditions": identified.conditions}
    names = (*population.states, *population.inputs)
    content: dict[str, Any] = {
        "kros": version("kros"),
        "units_of_measure": {c.name: c.unit for c in population.channels if c.name in identified.sizes},
        "largest_in_training": identified.sizes,
        "columns": {name: asdict(scaling_of(population.scaling, name)) for name in names},
        "sensor": {
            name: observer.sensor.get(name, Sensor()).no_finer_than(known.resolution[name]).model_dump()
            for name in population.measured
        },
        "trained_on": {**trained, "identify_on": known.identify_on},
        "as_it_runs": {**proof, "operating_box": certificate.box},
        "uncertain_set": {"worst_case_h2": facts.get("worst_case_h2"), "reason": facts.get("reason") or ""},
    }
    if calibration is not None and calibration.spec.parameter in observer.lifting.parameters:
        values = {name: getattr(calibration.spec, name) for name in ("angle", "ratio", "reference", "measured")}
        content["parameters"] = {calibration.spec.parameter: {**values, "lag_rad": calibration.lag_rad}}
    signals = {name: facts[fact] for fact, name in _SIGNALS.items() if fact in facts}
    content |= {"recorded_signals": signals} if signals else {}
    json: dict[str, Any] = plain(content)
    return json
