"""What is written into the file of an observer for those who put it into machines."""

from __future__ import annotations

from collections.abc import Mapping
from importlib.metadata import version
from typing import Any

from ..identify.identified import IdentifiedModels
from ..observer import ReliftCertificate
from .task import DesignTask


def about(task: DesignTask, identified: IdentifiedModels, certificate: ReliftCertificate, facts: Mapping[str, Any]) -> dict[str, Any]:
    """Return units of measure, largest sizes in training, certificates with their assumptions, and the version that made it.

    Parameters
    ----------
    task : DesignTask
    identified : IdentifiedModels
    certificate : ReliftCertificate
        As the observer runs.
    facts : mapping
        What the metrics say of it.
    """
    population, models = identified.population, identified.models(task.models.name)
    measured = [models.lifting.states[i] for i in models.measured]
    own = {"certified": certificate.certified, "reason": certificate.reason, "gain": certificate.gain, "box": certificate.box}
    return {
        "kros": version("kros"),
        "units_of_measure": {c.name: c.unit for c in population.channels if c.name in identified.sizes},
        "largest_in_training": identified.sizes,
        "resolution": {name: float(identified.facts.resolution[name]) for name in measured},
        "as_it_runs": {**own, "assumptions": certificate.assumptions},
        "uncertain_set": {"worst_case_h2": facts.get("worst_case_h2"), "reason": facts.get("reason", "")},
    }
