"""Constant gains: the model alone, the Kalman filter that does best on training episodes, and the residual-shaped one.

The residual-shaped observer runs rows fitted to single steps where these promise smaller errors, the Kalman filter all.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import suppress
from dataclasses import replace

import numpy as np

from ...core import Array, SynthesisError, frozen, gain
from ...observer.residual import (
    like_measurement_noise,
    mean_error_dynamics,
    mean_slopes,
    one_step_rows,
    residual_covariance,
    residual_models,
    with_rows,
)
from ...synthesis import Synthesis, kalman
from ...synthesis.residual_shaped.residual_h2 import residual_h2
from ..task import Design, DesignTask, Label, Method
from ..training import hidden_mean, percent_of


@frozen
class OpenLoop(Method):
    """The nominal model without correction."""

    name = "open_loop"
    label = Label("open loop", "the model without correction", baseline=True)

    def design(self, task: DesignTask) -> Design:
        """Return the model alone."""
        return task.designed(task.open_loop())


@frozen
class KalmanTuned(Method):
    """The Kalman filter of a model fitted to single steps, whose process noise does best in training."""

    name = "kalman_tuned"
    label = Label("tuned Kalman", "steady-state Kalman filter, noise tuned in training", "PURPLE", "--", baseline=True)

    def design(self, task: DesignTask) -> Design:
        """Return the candidate of least error of the hidden states; process noise is like the one-step residuals."""
        models, batch, n = task.models, task.training.read(), task.models.lifting.n_states
        lifting, nominal = models.lifting, models.index(task.unit)
        A, B = with_rows(models.A[nominal], models.B[nominal], *one_step_rows(lifting, batch))
        covariance = residual_covariance(lifting, A, B, batch)
        dynamics = mean_error_dynamics(A, mean_slopes(lifting, batch.states, batch.inputs, batch.parameters))
        noise, C = np.diag(task.noise**2), np.eye(n)[list(models.measured)]
        candidates = _candidates(dynamics, C, covariance, noise, models.sample_period_s)
        lift = gain(np.eye(lifting.n_lifted, n), models.sample_period_s)  # lifted functions are not corrected
        tried = [(level, replace(gains, controller=lift @ gains.controller)) for level, gains in candidates]
        observers = [task.observer(gains, (A, B)) for _, gains in tried]
        errors = hidden_mean(percent_of(observers, batch), models.measured) if tried else np.array([np.inf])
        first = int(np.argmin(errors))
        if not np.isfinite(errors[first]):
            raise SynthesisError(
                "Kalman filter: every candidate diverges on the training episodes; look at the models."
            )
        level, gains = tried[first]
        facts = {"process_noise_level": level, "rows_fitted_to_single_steps": list(lifting.states)}
        return Design(task.name, observers[first], gains, facts)


def _candidates(A: Array, C: Array, shape: Array, R: Array, dt: float) -> Iterator[tuple[float, Synthesis]]:
    """Sweep the size of white process noise over sixteen decades, the covariance itself among them."""
    base = like_measurement_noise(C @ shape @ C.T, R)
    for level in sorted((1 / base, *np.logspace(-6, 10, 9).tolist())):
        with suppress(SynthesisError):
            yield level, kalman(A, C, level * base * shape, R, dt)


@frozen
class ResidualH2(Method):
    """Kalman gains for the one-step residuals that a model leaves on the training episodes of all units."""

    name = "residual_h2"
    label = Label("residual-shaped H2", "noise shaped like the recorded residuals", "INK")
    correction_order: int = 12  # at most
    compared: int = 3  # most promising models that are tried on training episodes

    def design(self, task: DesignTask) -> Design:
        """Return the best of the models that promise the smallest errors."""
        given, row = task.models, task.models.index(task.unit)
        nominal = given.lifting, given.A[row], given.B[row], given.measured
        tried = residual_models(
            *nominal, task.training.read(), task.noise, given.output_scale[: given.lifting.n_states]
        )
        models = [model for model in tried if np.isfinite(model.promised).all()][: self.compared]
        if not models:
            raise SynthesisError(
                "Residual-shaped observer: no model promises bounded errors; check what is measured and the recordings."
            )
        syntheses = [
            residual_h2(model.problem, n_lifted=given.lifting.n_lifted, order=self.correction_order) for model in models
        ]
        observers = [task.observer(one, (model.A, model.B)) for model, one in zip(models, syntheses, strict=True)]
        best, error = task.best(observers)
        if not np.isfinite(error):
            raise SynthesisError("Residual-shaped observer: the nonlinear observer diverges on the training episodes.")
        facts = {
            "training_error_to_open_loop": error,
            "rows_fitted_to_single_steps": [given.lifting.states[i] for i in models[best].refitted],
        }
        return Design(task.name, observers[best], syntheses[best], facts)
