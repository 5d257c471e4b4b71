"""Maker of the residual-shaped observer: it may run rows of its own, fitted to single steps, where they promise smaller errors."""

from __future__ import annotations

from dataclasses import dataclass, fields
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from ..core.errors import SynthesisError
from ..lifting import Lifting
from ..observer import Observer, ResidualModel, residual_models, tune_observer
from ..synthesis import Synthesis, residual_h2
from .tuned import tuned_where_better
from .validation import Judge, rank

if TYPE_CHECKING:
    from .task import Made, Task

Array = npt.NDArray[np.float64]
MAX_ORDER = 12
_COMPARED = 3
_TUNE_S, _STEPS = 5.0, 8


@dataclass(frozen=True, eq=False)
class OwnModel(Synthesis):
    """A synthesis for a model of its own in place of the nominal unit's; no uncertain set around the nominal says anything about it.

    Parameters
    ----------
    A : ndarray, shape (n_lifted, n_lifted)
    B : ndarray, shape (n_lifted, m)
    lifting : Lifting, optional
        Where it is not that of the nominal model.
    replaces, internal
        As in `Observer`.
    reason : str
        Why there is no certificate for the uncertain set.
    """

    A: Array | None = None
    B: Array | None = None
    lifting: Lifting | None = None
    replaces: bool = False
    internal: int = 0
    reason: str = "the observer runs rows fitted to single steps, not the nominal model that the uncertain set surrounds"


def make_residual_h2(task: Task) -> Made:
    """Kalman gains for the one-step residuals that a model leaves on the training episodes of all units.

    The model is the nominal unit's, or that with some rows fitted to single steps. Those that promise the smallest errors of the hidden states are
    compared on the training episodes, by the same rule as all observers that are tuned.
    """
    judge, nominal = (
        task.tuning.read(),
        Observer.open_loop(
            task.name,
            task.models.lifting,
            task.models.A[task.models.index(task.unit)],
            task.models.B[task.models.index(task.unit)],
            task.models.measured,
            task.models.recorded_inputs,
            task.models.sample_period_s,
        ),
    )
    models = promising(task)[:_COMPARED]
    made = [design(task, model) for model in models]
    percents = judge.percent_of_all([nominal, *(task.observer(synthesis) for synthesis in made)])
    ranks = [rank(percent, percents[0], task.models.measured) for percent in percents[1:]]
    best = min(range(len(made)), key=lambda i: ranks[i])
    if not np.isfinite(ranks[best][1]):
        raise SynthesisError(
            "Residual-shaped observer: it diverges on the training episodes, where it is retracted and lifted at every step."
        )
    facts: dict[str, Any] = {"training_error_to_open_loop": ranks[best][1], "order_reduction_percent": made[best].gap_percent}
    facts["rows_fitted_to_single_steps"] = [task.models.lifting.states[i] for i in models[best].refitted]
    if not task.tune:
        return made[best], facts, task.problem
    synthesis, found = tuned(task, judge, made[best])
    return synthesis, facts | found, task.problem


def tuned(task: Task, judge: Judge, synthesis: Synthesis) -> tuple[Synthesis, dict[str, Any]]:
    """Return the synthesis with gains and rows tuned on training episodes, where that is better on those that were held out."""
    start = task.observer(synthesis)
    kept, facts = tuned_where_better(task, judge.first(_TUNE_S / task.models.sample_period_s), start, _steps)
    if kept is start:
        return synthesis, facts
    own = {f.name: getattr(synthesis, f.name) for f in fields(Synthesis)} | {"controller": kept.controller}
    return OwnModel(**own, A=kept.A, B=kept.B, reason="the observer runs rows that were tuned on training episodes"), facts


def _steps(judge: Judge, start: Observer) -> Observer:
    values = judge.parameters if start.lifting.parameters else None
    return tune_observer(start, judge.batch.states, judge.batch.inputs, values, iterations=_STEPS).observer


def promising(task: Task) -> list[ResidualModel]:
    """Return the models that may be run, the one that promises the smallest errors first; those that promise nothing are left out."""
    models, row, judge = task.models, task.models.index(task.unit), task.tuning.read()
    n, batch = models.lifting.n_states, judge.batch
    found = residual_models(
        models.lifting,
        models.A[row],
        models.B[row],
        models.measured,
        batch.states,
        batch.inputs,
        batch.lengths,
        [key.unit for key in batch.keys],
        judge.parameters if models.lifting.parameters else None,
        task.noise,
        models.output_scale[:n],
        models.sample_period_s,
    )
    usable = [model for model in found if np.isfinite(model.promised).all()]
    if not usable:
        raise SynthesisError("Residual-shaped observer: no model promises bounded errors; check what is measured and the recordings.")
    return usable


def design(task: Task, model: ResidualModel) -> Synthesis:
    """Return the synthesis for a model."""
    models, n = task.models, task.models.lifting.n_states
    made = residual_h2(
        model.dynamics,
        task.selector[:, :n],
        model.spectra,
        task.noise,
        models.output_scale[:n],
        models.sample_period_s,
        n_lifted=models.lifting.n_lifted,
        max_order=MAX_ORDER,
    )
    if not model.refitted:
        return made
    return OwnModel(**{f.name: getattr(made, f.name) for f in fields(Synthesis)}, A=model.A, B=model.B)
