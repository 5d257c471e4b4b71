"""Constant gains: the model alone, and the Kalman filter that does best on training episodes."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any, ClassVar

import numpy as np

from ...core.errors import SynthesisError
from ...core.lti import gain
from ...observer.baselines.kalman import kalman_candidates
from ...observer.residual.models import Refitted, refitted_models
from ...observer.residual.one_step import mean_error_dynamics, mean_slopes, one_step_covariance
from ...synthesis import Synthesis
from ..task import Design, DesignTask, Method
from ..validation import hidden_mean, percent_of

EQUAL, RESIDUAL = "equal share of every range", "one-step residuals"


@dataclass(frozen=True)
class OpenLoop(Method):
    """The nominal model without correction."""

    name: ClassVar[str] = "open_loop"

    def design(self, task: DesignTask) -> Design:
        """Return the model alone."""
        return task.designed(task.open_loop())


@dataclass(frozen=True)
class KalmanTuned(Method):
    """Kalman gains for the white process noise that does best on training episodes."""

    name: ClassVar[str] = "kalman_tuned"

    def design(self, task: DesignTask) -> Design:
        """Return the candidate of least error of the hidden states; the model alone where none is better."""
        tried = [Candidate(task.open_loop(), {"process_noise_level": 0.0}), *candidates(task)]
        models = [(None, None) if t.model is None else (t.model.A, t.model.B) for t in tried]
        observers = [task.observer(t.synthesis, *model) for t, model in zip(tried, models, strict=True)]
        errors = hidden_mean(percent_of(observers, task.training.read()), task.models.measured)
        first = int(np.argmin(errors))
        if not np.isfinite(errors[first]):
            diverges = "every candidate diverges on the training episodes, and so does the model alone"
            raise SynthesisError(f"Kalman filter: {diverges}; look at the models first.")
        best = tried[first]
        rows = best.model.rows if best.model else ()
        facts = {**best.facts, "rows_fitted_to_single_steps": [task.models.lifting.states[i] for i in rows]}
        facts["correction_off"] = first == 0
        if np.isfinite(errors[0]):
            facts["training_error_to_open_loop"] = float(errors[first] / errors[0])
        return Design(task.name, observers[first], best.synthesis, facts)


@dataclass(frozen=True, eq=False)
class Candidate:
    """Gains, the settings behind them, and the model where it is not the nominal unit's."""

    synthesis: Synthesis
    facts: dict[str, Any]
    model: Refitted | None = None


def candidates(task: DesignTask) -> list[Candidate]:
    """Return gains for process noise of two shapes and many sizes, for the nominal model and models with new rows."""
    models, batch, n = task.models, task.training.read(), task.models.lifting.n_states
    lifting, R, nominal = models.lifting, np.diag(task.noise**2), models.index(task.unit)
    refitted, residual = refitted_models(lifting, models.A[nominal], models.B[nominal], models.measured, batch)
    covariance = one_step_covariance(residual, batch.lengths - 1 - lifting.history)
    slopes, tried = mean_slopes(lifting, batch.states, batch.inputs, batch.parameters), []
    for model in refitted:
        dynamics = mean_error_dynamics(model.A, slopes)
        shapes = {RESIDUAL: covariance[np.ix_(model.columns, model.columns)]}
        shapes |= {} if model.rows else {EQUAL: models.output_scale[:n]}
        for name, shape in shapes.items():
            for level, gains in kalman_candidates(dynamics, task.selector[:, :n], shape, R, models.sample_period_s):
                facts = {"process_noise_level": level, "process_noise_shape": name}
                tried.append(Candidate(_padded(gains, lifting.n_lifted), facts, model if model.rows else None))
    return tried


def _padded(synthesis: Synthesis, n_lifted: int) -> Synthesis:
    """Add rows of zeros for the lifted functions."""
    K = synthesis.controller
    return replace(synthesis, controller=gain(np.vstack([K.D, np.zeros((n_lifted - len(K.D), K.n_inputs))]), K.dt))
