"""Makers of the baselines that are tuned: every one is the best of its kind on training episodes."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any, TypeVar

import numpy as np

from ..core.errors import SynthesisError
from ..core.lti import StateSpace, gain
from ..observer import kalman_candidates, luenberger_candidates
from ..synthesis import Synthesis
from .validation import rank

if TYPE_CHECKING:
    from .task import Made, Task

T = TypeVar("T")
EQUAL, RESIDUAL = "equal share of every range", "one-step residuals"


def kalman_tuned(task: Task) -> Made:
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
    facts: dict[str, Any] = {"process_noise_level": level, "process_noise_shape": shape_name, "training_error_to_open_loop": share}
    return best, facts, task.problem


def make_luenberger(task: Task) -> Made:
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
    return best, {"poles_faster_by": factor, "training_error_to_open_loop": share}, task.problem


def best_of(task: Task, tried: Sequence[tuple[T, Synthesis]], what: str) -> tuple[T, Synthesis, float]:
    """Return the setting and synthesis that rank first on the training episodes, with their error relative to the open loop's.

    Raises
    ------
    SynthesisError
        When all diverge.
    """
    n, q = task.models.lifting.n_lifted, len(task.models.measured)
    silent = Synthesis("open_loop", gain(np.zeros((n, q)), task.models.sample_period_s), tried[0][1].status, tried[0][1].injection)
    percents = task.tuning.read().percent_of_all([task.observer(s) for s in (silent, *(s for _, s in tried))])
    ranks = [rank(percent, percents[0], task.models.measured) for percent in percents[1:]]
    first = min(range(len(tried)), key=lambda i: ranks[i])
    if not np.isfinite(ranks[first][1]):
        raise SynthesisError(f"{what}: every candidate diverges on the training episodes.")
    return *tried[first], ranks[first][1]


def _padded(synthesis: Synthesis, n_lifted: int) -> Synthesis:
    """Add rows of zeros for the lifted functions."""
    from dataclasses import replace

    K: StateSpace = synthesis.controller
    return replace(synthesis, controller=gain(np.vstack([K.D, np.zeros((n_lifted - len(K.D), K.n_inputs))]), K.dt))
