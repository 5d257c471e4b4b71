"""Observers for the set of signals: a nominal whose certified errors are small, and the Kalman predictor for its residuals.

The worst member of the set is its cover, and what an observer is certified to stay below is a sum over bands (`kros.observer.certificate.signals`). Rows of
a nominal need not be those of a unit, nor of free runs: models that are refined for long free runs miss single steps by residuals that nearly cancel in
the error, and the cancelling is lost where signals are covered. So nominals compete by certified cost: the unit, the population's mean, rows fitted to
single steps, and rows fitted to the errors of the observer that runs them, in turn with its gains.
"""

from __future__ import annotations

import logging
import time
from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import numpy.typing as npt

from ...core.errors import KrosError, SynthesisError
from ...observer import Observer, Runtime, relift_certificate
from ...observer.certificate.signals import SignalBound, signal_bound
from ...observer.residual.models import refitted_models
from ...observer.residual.one_step import mean_error_dynamics, mean_slopes, one_step_residual, residual_spectra
from ...observer.residual.signal_bounds import signal_lower_bounds
from ...observer.tuning.observer_rows import tune_observer
from ...synthesis import ResidualProblem, Status, Synthesis, residual_h2
from ...uncertainty.coprime.bands import BandEnergies
from ...uncertainty.coprime.signals import SignalSet
from ..certificates import certified_on, scales_of
from ..task import DesignResult, DesignTask
from ..validation import ValidationSet, hidden_mean
from .residual_shaped import MAX_ORDER
from .tuned import held_out

log = logging.getLogger(__name__)
Array = npt.NDArray[np.float64]
SIGNALS = "signals"
UNCOVERED = (
    "the observer is certified for the signals that a model of its own leaves, not for the set around the nominal unit"
)
_STEPS, _ROUNDS, _EPISODES = 8, 2, 12
_UNKNOWN: dict[str, Any] = {"h2_norm": None, "lower_bound": None, "gap_percent": None}  # of tuned gains


@dataclass(frozen=True, eq=False)
class Candidate:
    """An observer for the set of signals of its own model, with what it is certified to stay below."""

    nominal: str
    observer: Observer
    synthesis: Synthesis
    bound: SignalBound

    @property
    def cost(self) -> float:
        """Geometric mean over the hidden states of the certified error for the cover; infinite where there is none."""
        return float(hidden_mean(self.bound.cover, self.observer.measured)) if self.bound.certified else np.inf


class Judge:
    """Certifies observers for the signals of their own models, on the episodes that all observers are certified on."""

    def __init__(self, task: DesignTask, data: ValidationSet) -> None:
        self.task, self.data = task, data
        self._energies: dict[bytes, BandEnergies] = {}

    def __call__(self, nominal: str, observer: Observer, synthesis: Synthesis) -> Candidate:
        """Return an observer with what it is certified to stay below."""
        certificate = relift_certificate(
            observer, scales=scales_of([observer], self.data, self.task)[0], mismatch=False
        )
        return Candidate(
            nominal, observer, synthesis, signal_bound(certificate, observer, self.data.batch, known=self._energies)
        )


def design_for_signals(task: DesignTask) -> DesignResult:
    """The Kalman predictor for the residuals of a nominal of its own, tuned or not: the one of least certified error."""
    began, data = time.perf_counter(), task.training.read()
    best, facts = chosen(task, data)
    notes = (
        *best.synthesis.notes,
        "The set: signals with energies in bands below the cover of all units' residuals, of the observer's own model.",
    )
    synthesis = replace(
        best.synthesis, method=task.method, status=Status.CERTIFIED, solve_s=time.perf_counter() - began, notes=notes
    )
    return DesignResult(task.name, best.observer, synthesis, facts, task.problem, UNCOVERED)


def chosen(task: DesignTask, data: ValidationSet) -> tuple[Candidate, dict[str, Any]]:
    """Return the observer that is taken, and facts for the records."""
    found = [candidate for candidate in candidates(task, data) if np.isfinite(candidate.cost)]
    if not found:
        raise SynthesisError(
            "Worst-case synthesis for signals: no observer has a certificate as it runs; check what is measured, and the lifting's slopes."
        )
    best = min(found, key=lambda candidate: candidate.cost)
    cost: dict[str, float] = {}
    for one in found:
        cost[one.nominal] = min(one.cost, cost.get(one.nominal, np.inf))
    states, measured = best.observer.recorded, best.observer.measured
    lower = lower_bounds(task, certified_on(task), best.observer)
    facts: dict[str, Any] = {"set": SIGNALS, "nominal": best.nominal}
    facts["certified_cost_percent"] = {name: 100 * value for name, value in cost.items()}
    facts["set_lower_bound_percent"] = {
        name: 100 * float(value) if np.isfinite(value) else None
        for i, (name, value) in enumerate(zip(states, lower, strict=True))
        if i not in measured
    }
    return best, facts


def lower_bounds(task: DesignTask, data: ValidationSet, observer: Observer) -> Array:
    """Return the errors that no other correction of an observer's model is certified to stay below, over the ranges."""
    batch, models = data.batch, task.models
    dynamics = mean_error_dynamics(
        observer.A, mean_slopes(models.lifting, batch.states, batch.inputs, batch.parameters)
    )
    C = task.selector[:, : models.lifting.n_states]
    return signal_lower_bounds(dynamics, C, task.noise, signals_of(data, observer), models.sample_period_s)


def signals_of(data: ValidationSet, observer: Observer) -> SignalSet:
    """Return the residuals of an observer's model, with the error of its first estimate."""
    batch, history = data.batch, observer.lifting.history
    values = observer.own(batch.parameters)
    residual = one_step_residual(observer.lifting, observer.A, observer.B, batch.states, batch.inputs, values)
    start = batch.states[history] - observer.initial(batch.states[history][:, list(observer.measured)], values)
    return SignalSet.of(residual, batch.lengths - 1 - history, batch.units, start)


def candidates(task: DesignTask, data: ValidationSet) -> Iterator[Candidate]:
    """Yield observers of all nominals as they are; then, rows and gains improved in turn, of the mean of the units and of rows fitted to single steps."""
    judge = Judge(task, certified_on(task))
    models, n = task.models, task.models.lifting.n_states
    *others, (name, A, B) = task.nominals
    for other in others:
        yield from attempts(task, data, *other, judge, 0)
    yield from attempts(task, data, name, A, B, judge, 1)
    for model in refitted_models(models.lifting, A, B, models.measured, data.batch)[0]:
        if len(model.rows) == n:
            yield from attempts(task, data, "single steps", model.A, model.B, judge, _ROUNDS)


def attempts(
    task: DesignTask, data: ValidationSet, name: str, A: Array, B: Array, judge: Judge, rounds: int
) -> Iterator[Candidate]:
    """Yield the observer of a nominal, and what becomes of it when rows and gains are fitted in turn; those that fail end it."""
    seen, what = fitting(data), name
    try:
        for turn in range(rounds + 1):
            synthesis = gains(task, data, A, B)
            observer = task.observer(synthesis, A, B)
            yield judge(what, observer, synthesis)
            if turn == rounds:
                return
            observer, what = tuned(seen, observer), f"{name}, fitted"
            yield judge(what, observer, replace(synthesis, controller=observer.controller, **_UNKNOWN))
            A, B = observer.A, observer.B
    except (KrosError, np.linalg.LinAlgError) as error:
        log.info("%s, nominal %s: %s", task.name, what, error)


def fitting(data: ValidationSet) -> ValidationSet:
    """Return the episodes that rows and gains are fitted to, some of those that observers are not judged on."""
    held = held_out(data.batch.keys)
    seen = [i for i, unseen in enumerate(held) if not unseen] or list(range(len(held)))
    some = np.unique(np.linspace(0, len(seen) - 1, min(len(seen), _EPISODES)).round().astype(int))
    return data.part([seen[i] for i in some])


def gains(task: DesignTask, data: ValidationSet, A: Array, B: Array) -> Synthesis:
    """Return the Kalman predictor for the mean of the residual spectra that a model leaves on all units."""
    models, n, batch = task.models, task.models.lifting.n_states, data.batch
    residual = one_step_residual(models.lifting, A, B, batch.states, batch.inputs, batch.parameters)
    spectra = residual_spectra(residual, batch.lengths - 1 - models.lifting.history, batch.units)
    dynamics = mean_error_dynamics(A, mean_slopes(models.lifting, batch.states, batch.inputs, batch.parameters))
    problem = ResidualProblem(dynamics, task.selector[:, :n], spectra, task.noise, np.ones(n), models.sample_period_s)
    return residual_h2(problem, n_lifted=models.lifting.n_lifted, max_order=MAX_ORDER)


def tuned(data: ValidationSet, start: Observer) -> Observer:
    """Return an observer whose rows and gains are fitted to its errors."""
    found = tune_observer(replace(start, runtime=Runtime()), data.on_time.batch, _STEPS)[0]
    return replace(found, runtime=start.runtime)
