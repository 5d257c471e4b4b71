"""Constant gains: the model alone, Kalman filters and the Luenberger observer, each the best of its kind on training episodes."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import TypeVar

import numpy as np

from ...core.errors import SynthesisError
from ...core.lti import gain
from ...observer import kalman_candidates, luenberger_candidates, noise_covariances
from ...synthesis import Synthesis, kalman
from ..task import DesignResult, DesignTask, first_of, without_correction

T = TypeVar("T")
EQUAL, RESIDUAL = "equal share of every range", "one-step residuals"


def design_open_loop(task: DesignTask) -> DesignResult:
    """The nominal model without correction."""
    return task.designed(without_correction(task))


def design_kalman_white(task: DesignTask) -> DesignResult:
    """Kalman gains for noise guessed as anybody would: one-step residuals and quantisation."""
    Q, R = noise_covariances(task.models.residual_covariance, task.noise * np.sqrt(12))
    return task.designed(kalman(task.dynamics, task.selector, Q, R, task.models.sample_period_s))


def design_kalman_tuned(task: DesignTask) -> DesignResult:
    """Kalman gains for the white process noise that does best on training episodes.

    Its size is swept over sixteen decades, its shape is that of the one-step residuals or the same share of every state's largest value.
    """
    shapes = {EQUAL: task.models.output_scale, RESIDUAL: task.models.residual_covariance.mean(axis=0)}
    R, dt = np.diag(task.noise**2), task.models.sample_period_s
    tried = [
        ((name, level), synthesis)
        for name, shape in shapes.items()
        for level, synthesis in kalman_candidates(task.dynamics, task.selector, shape, R, dt)
    ]
    (shape_name, level), best, share = best_of(task, tried, "Tuned Kalman filter")
    return task.designed(best, process_noise_level=level, process_noise_shape=shape_name, training_error_to_open_loop=share)


def design_luenberger(task: DesignTask) -> DesignResult:
    """Poles of the original states' error dynamics placed as much faster than the model's as does best on training episodes.

    Rows of lifted functions are computed anew at every step and need no correction.
    """
    n = task.models.lifting.n_states
    tried = list(luenberger_candidates(task.dynamics[:n, :n], task.selector[:, :n], task.models.sample_period_s))
    if not tried:
        raise SynthesisError(
            "Luenberger observer: the poles cannot be placed; the measurement hardly sees some state, measure another one."
        )
    padded = [(factor, _padded(synthesis, task.models.lifting.n_lifted)) for factor, synthesis in tried]
    factor, best, share = best_of(task, padded, "Luenberger observer")
    return task.designed(best, poles_faster_by=factor, training_error_to_open_loop=share)


def best_of(task: DesignTask, tried: Sequence[tuple[T, Synthesis]], what: str) -> tuple[T, Synthesis, float]:
    """Return the setting and synthesis that rank first on the training episodes, with their error relative to the open loop's.

    Raises
    ------
    SynthesisError
        When all diverge.
    """
    ranks = task.ranked([task.observer(synthesis) for _, synthesis in tried])
    first = first_of(ranks)
    if not np.isfinite(ranks[first][1]):
        raise SynthesisError(f"{what}: every candidate diverges on the training episodes.")
    return *tried[first], ranks[first][1]


def _padded(synthesis: Synthesis, n_lifted: int) -> Synthesis:
    """Add rows of zeros for the lifted functions."""
    K = synthesis.controller
    return replace(synthesis, controller=gain(np.vstack([K.D, np.zeros((n_lifted - len(K.D), K.n_inputs))]), K.dt))
