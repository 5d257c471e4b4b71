"""Constant gains: the model alone, and the Kalman filter that does best on training episodes."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from ...core.errors import SynthesisError
from ...core.lti import gain
from ...observer.baselines.kalman import kalman_candidates
from ...observer.residual.models import Refitted, refitted_models
from ...observer.residual.one_step import mean_error_dynamics, mean_slopes, one_step_covariance
from ...synthesis import Synthesis
from ..task import DesignResult, DesignTask, without_correction
from ..validation import ValidationSet, hidden_mean
from .residual_shaped import FITTED

EQUAL, RESIDUAL = "equal share of every range", "one-step residuals"


def design_open_loop(task: DesignTask) -> DesignResult:
    """The nominal model without correction."""
    return task.designed(without_correction(task))


def design_kalman_tuned(task: DesignTask) -> DesignResult:
    """Kalman gains for the white process noise that does best on training episodes."""
    models, data, n = task.models, task.training.read(), task.models.lifting.n_states
    lifting, batch, R = models.lifting, data.batch, np.diag(task.noise**2)
    nominal = models.index(task.unit)
    refitted, residual = refitted_models(lifting, models.A[nominal], models.B[nominal], models.measured, batch)
    covariance = one_step_covariance(residual, batch.lengths - 1 - lifting.history)
    tried, slopes = [], mean_slopes(lifting, batch.states, batch.inputs, batch.parameters)
    for model in refitted:
        dynamics = mean_error_dynamics(model.A, slopes)
        shapes = {RESIDUAL: covariance[np.ix_(model.columns, model.columns)]} | (
            {} if model.rows else {EQUAL: models.output_scale[:n]}
        )
        for name, shape in shapes.items():
            for level, found in kalman_candidates(dynamics, task.selector[:, :n], shape, R, models.sample_period_s):
                facts = {"process_noise_level": level, "process_noise_shape": name}
                tried.append(Tried(_padded(found, lifting.n_lifted), facts, model if model.rows else None))
    return best_of(task, tried, data, process_noise_level=0.0)


@dataclass(frozen=True, eq=False)
class Tried:
    """A candidate: gains, the settings behind them, and the model where it is not the nominal unit's."""

    synthesis: Synthesis
    facts: dict[str, Any]
    model: Refitted | None = None


def best_of(task: DesignTask, tried: Sequence[Tried], data: ValidationSet, **off: float) -> DesignResult:
    """Return the candidate of least error of the hidden states on training episodes; the model alone where none is better."""
    candidates = [Tried(without_correction(task), off), *tried]
    models = [(None, None) if t.model is None else (t.model.A, t.model.B) for t in candidates]
    observers = [task.observer(t.synthesis, *model) for t, model in zip(candidates, models, strict=True)]
    errors = hidden_mean(data.percent_of_all(observers), task.models.measured)
    first = int(np.argmin(errors))
    if not np.isfinite(errors[first]):
        raise SynthesisError(
            "Every candidate diverges on the training episodes, and so does the model alone; look at Models first."
        )
    best = candidates[first]
    rows = best.model.rows if best.model else ()
    facts = {
        **best.facts,
        "rows_fitted_to_single_steps": [task.models.lifting.states[i] for i in rows],
        "correction_off": first == 0,
    }
    if np.isfinite(errors[0]):
        facts["training_error_to_open_loop"] = float(errors[first] / errors[0])
    return DesignResult(task.name, observers[first], best.synthesis, facts, task.problem, FITTED if rows else "")


def _padded(synthesis: Synthesis, n_lifted: int) -> Synthesis:
    """Add rows of zeros for the lifted functions."""
    K = synthesis.controller
    return replace(synthesis, controller=gain(np.vstack([K.D, np.zeros((n_lifted - len(K.D), K.n_inputs))]), K.dt))
