"""The residual-shaped observer: it may run rows fitted to single steps, where these do better on training episodes."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from ... import synthesis  # solvers load when they are used
from ...core.errors import SynthesisError
from ...observer import Observer
from ...observer.residual.models import Refitted, refitted_models
from ...observer.residual.one_step import mean_error_dynamics, mean_slopes, residual_spectra
from ...synthesis import Synthesis
from ..task import Design, DesignTask, Method


@dataclass(frozen=True)
class ResidualH2(Method):
    """Kalman gains for the one-step residuals that a model leaves on the training episodes of all units."""

    name: ClassVar[str] = "residual_h2"
    max_order: int = 12  # of the observer beside the model

    def design(self, task: DesignTask) -> Design:
        """Return the observer that does best, of the model as identified and with rows fitted to single steps."""
        models, row, batch = task.models, task.models.index(task.unit), task.training.read().batch
        lifting, n, tried = models.lifting, models.lifting.n_states, list[tuple[Refitted, Synthesis, Observer]]()
        refitted, residual = refitted_models(lifting, models.A[row], models.B[row], models.measured, batch)
        spectra = residual_spectra(residual, batch.lengths - 1 - lifting.history, batch.units)
        slopes = mean_slopes(lifting, batch.states, batch.inputs, batch.parameters)
        C, scale, reason = task.selector[:, :n], models.output_scale[:n], ""
        for model in refitted:
            own, dynamics = spectra[..., model.columns, :][..., model.columns], mean_error_dynamics(model.A, slopes)
            problem = synthesis.ResidualProblem(dynamics, C, own, task.noise, scale, models.sample_period_s)
            try:
                one = synthesis.residual_h2(problem, n_lifted=lifting.n_lifted, max_order=self.max_order)
                tried.append((model, one, task.observer(one, *((model.A, model.B) if model.rows else ()))))
            except SynthesisError as failure:
                reason = str(failure)
        if not tried:
            raise SynthesisError(reason)
        best, error = task.best([observer for *_, observer in tried])
        if not np.isfinite(error):
            raise SynthesisError("Residual-shaped observer: the nonlinear observer diverges on the training episodes.")
        model, one, observer = tried[best]
        facts = {
            "training_error_to_open_loop": error,
            "order_reduction_percent": one.gap_percent,
            "rows_fitted_to_single_steps": [lifting.states[i] for i in model.rows],
        }
        return Design(task.name, observer, one, facts)
