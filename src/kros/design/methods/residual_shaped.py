"""The residual-shaped observer: it may run rows of its own, fitted to single steps, where they promise smaller errors."""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt

from ...core.errors import SynthesisError
from ...observer.residual.models import ResidualModel, residual_models
from ...synthesis import ResidualProblem, Synthesis, residual_h2
from ..task import DesignResult, DesignTask, first_of

Array = npt.NDArray[np.float64]
MAX_ORDER = 12
FITTED = "the observer runs rows fitted to single steps, not the nominal model that the uncertain set surrounds"
_COMPARED = 3


def design_residual_h2(task: DesignTask) -> DesignResult:
    """Kalman gains for the one-step residuals that a model leaves on the training episodes of all units."""
    models = promising(task)[:_COMPARED]
    syntheses = [gains_for(task, model) for model in models]
    observers = [
        task.observer(found, model.A, model.B) if model.refitted else task.observer(found)
        for model, found in zip(models, syntheses, strict=True)
    ]
    ranks = task.ranked(observers)
    best = first_of(ranks)
    if not np.isfinite(ranks[best][1]):
        raise SynthesisError(
            "Residual-shaped observer: it diverges on the training episodes, where it is retracted and re-lifted at every step."
        )
    facts: dict[str, Any] = {
        "training_error_to_open_loop": ranks[best][1],
        "order_reduction_percent": syntheses[best].gap_percent,
        "rows_fitted_to_single_steps": [task.models.lifting.states[i] for i in models[best].refitted],
    }
    uncovered = FITTED if models[best].refitted else ""
    return DesignResult(task.name, observers[best], syntheses[best], facts, task.problem, uncovered)


def promising(task: DesignTask) -> list[ResidualModel]:
    """Return the models that may be run, the one that promises the smallest errors first; those that promise nothing are left out."""
    models, row, data = task.models, task.models.index(task.unit), task.training.read()
    n = models.lifting.n_states
    found = residual_models(
        models.lifting,
        models.A[row],
        models.B[row],
        models.measured,
        data.batch,
        task.noise,
        models.output_scale[:n],
    )
    usable = [model for model in found if np.isfinite(model.promised).all()]
    if not usable:
        raise SynthesisError(
            "Residual-shaped observer: no model promises bounded errors; check what is measured and the recordings."
        )
    return usable


def gains_for(task: DesignTask, model: ResidualModel) -> Synthesis:
    """Return the synthesis for a model."""
    models, n = task.models, task.models.lifting.n_states
    return residual_h2(
        ResidualProblem(
            model.dynamics,
            task.selector[:, :n],
            model.spectra,
            task.noise,
            models.output_scale[:n],
            models.sample_period_s,
        ),
        n_lifted=models.lifting.n_lifted,
        max_order=MAX_ORDER,
    )
