"""The residual-shaped observer: it may run rows fitted to single steps, where these promise smaller errors."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from ... import synthesis  # solvers load when they are used
from ...core.errors import SynthesisError
from ...observer.residual.models import ResidualModel, residual_models
from ...synthesis import Synthesis
from ..task import Design, DesignTask, Method


@dataclass(frozen=True)
class ResidualH2(Method):
    """Kalman gains for the one-step residuals that a model leaves on the training episodes of all units."""

    name: ClassVar[str] = "residual_h2"
    max_order: int = 12  # of the observer beside the model
    compared: int = 3  # most promising models that are tried on training episodes

    def design(self, task: DesignTask) -> Design:
        """Return the best of the models that promise the smallest errors."""
        models = promising(task)[: self.compared]
        syntheses = [self.gains(task, model) for model in models]
        observers = [
            task.observer(one, model.A, model.B) if model.refitted else task.observer(one)
            for model, one in zip(models, syntheses, strict=True)
        ]
        best, error = task.best(observers)
        if not np.isfinite(error):
            raise SynthesisError("Residual-shaped observer: the nonlinear observer diverges on the training episodes.")
        facts = {
            "training_error_to_open_loop": error,
            "order_reduction_percent": syntheses[best].gap_percent,
            "rows_fitted_to_single_steps": [task.models.lifting.states[i] for i in models[best].refitted],
        }
        return Design(task.name, observers[best], syntheses[best], facts)

    def gains(self, task: DesignTask, model: ResidualModel) -> Synthesis:
        """Return the synthesis for a model."""
        models, n = task.models, task.models.lifting.n_states
        C, scale, dt = task.selector[:, :n], models.output_scale[:n], models.sample_period_s
        problem = synthesis.ResidualProblem(model.dynamics, C, model.spectra, task.noise, scale, dt)
        return synthesis.residual_h2(problem, n_lifted=models.lifting.n_lifted, max_order=self.max_order)


def promising(task: DesignTask) -> list[ResidualModel]:
    """Return models with bounded promised errors, the smallest first."""
    models, row = task.models, task.models.index(task.unit)
    nominal = models.lifting, models.A[row], models.B[row], models.measured
    scale = models.output_scale[: models.lifting.n_states]
    tried = residual_models(*nominal, task.training.read(), task.noise, scale)
    usable = [model for model in tried if np.isfinite(model.promised).all()]
    if not usable:
        raise SynthesisError(
            "Residual-shaped observer: no model promises bounded errors; check what is measured and the recordings."
        )
    return usable
