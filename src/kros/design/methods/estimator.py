"""The estimator: a regression on a bank of filters, from all training episodes of all units and conditions."""

from __future__ import annotations

import time
from dataclasses import replace

import numpy as np

from ...observer import Recordings, identify_estimator
from ...observer.sensor import sides
from ...synthesis import Status, Synthesis
from ..task import DesignResult, DesignTask


def design_estimator(task: DesignTask) -> DesignResult:
    """Identify the estimator; what the sensors are declared to be is in its training episodes."""
    began, models = time.perf_counter(), task.models
    training = task.recordings or task.training
    recordings = Recordings.of(training.keys, training.read_one)
    nominal = {name: float(values[models.index(task.unit)]) for name, values in models.parameters.items()}
    found = identify_estimator(
        task.name,
        models.lifting,
        models.measured,
        models.recorded_inputs,
        recordings,
        models.sample_period_s,
        nominal,
        task.estimator,
    )
    bounds = found.observer.runtime
    lower, upper = sides(task.limits, found.observer.lifting.states)
    if bounds.lower is not None and bounds.upper is not None:
        lower, upper = np.maximum(lower, bounds.lower), np.minimum(upper, bounds.upper)
    observer = replace(
        found.observer,
        runtime=replace(bounds, lower=lower, upper=upper),
        seen=training.seen,
        sensor=task.sensor,
    )
    seconds = time.perf_counter() - began
    synthesis = Synthesis("estimator", observer.controller, Status.CERTIFIED, observer.injection, solve_s=seconds)
    return DesignResult(task.name, observer, synthesis, found.facts, task.problem)
