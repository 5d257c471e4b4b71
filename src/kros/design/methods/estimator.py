"""The estimator: a regression on a bank of filters, from all training episodes of all units and conditions."""

from __future__ import annotations

from dataclasses import field, replace

import numpy as np

from ...core import frozen
from ...observer import EstimatorSettings, Recordings, Seen, Sensor, identify_estimator
from ...synthesis import Status, Synthesis
from ..task import Design, DesignTask, Label, Method


@frozen
class Estimator(Method):
    """Regression on filtered measurements and inputs; it is trained with the declared sensors."""

    name = "estimator"
    label = Label("estimator", "stable filter bank with a linear readout", "SKY", "-.")
    settings: EstimatorSettings = field(default_factory=EstimatorSettings)

    def design(self, task: DesignTask) -> Design:
        """Identify the estimator."""
        models, whole = task.models, task.recordings
        bias = np.array([whole.sensor.get(models.lifting.states[i], Sensor()).bias for i in models.measured])
        recordings = Recordings.of(whole.keys, whole.read_one, bias)
        channels = models.lifting, models.measured, models.recorded_inputs
        settings = models.sample_period_s, models.parameters_of(task.unit), self.settings
        poles = np.linalg.eigvals(models.A[models.index(task.unit)]).tolist()
        identified = identify_estimator(task.name, *channels, recordings, *settings, poles)
        observer = identified.observer
        start = np.pad(task.training.runtime.first(len(observer.recorded)), (0, observer.internal))
        runtime = replace(observer.runtime, start=start)
        observer = replace(observer, seen=self._seen(task), sensor=whole.sensor, runtime=runtime)
        synthesis = Synthesis(self.name, observer.controller, Status.CERTIFIED, observer.injection)
        return Design(task.name, observer, synthesis, identified.facts)

    def _seen(self, task: DesignTask) -> Seen | None:
        """Return the sizes seen in training, without those of coordinates that go on for ever."""
        seen, models, settings = task.recordings.seen, task.models, self.settings
        if seen is None:
            return None
        free = {name for first, others in settings.unbounded.items() for name in (first, *others)}
        measured = [models.lifting.states[i] in free for i in models.measured]
        inputs = [name in free for name in models.recorded_inputs]
        return Seen(np.where(measured, 0.0, seen.measured), np.where(inputs, 0.0, seen.inputs))
