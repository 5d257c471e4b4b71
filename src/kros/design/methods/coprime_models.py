"""Observers for the set of models in left coprime factors (`kros.uncertainty.coprime.models`)."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import numpy.typing as npt

from ...core.errors import SynthesisError
from ...core.lti import StateSpace
from ...observer.residual.one_step import mean_error_dynamics, mean_slopes
from ...synthesis import Injection, ObserverProblem, Synthesis, worst_case_h2, worst_case_hinf
from ...uncertainty import Form
from ...uncertainty.coprime.bands import BandEnergies, band_edges
from ...uncertainty.coprime.models import ModelDifferences
from ..task import DesignResult, DesignTask
from ..validation import ValidationSet

Array = npt.NDArray[np.float64]
MODELS = "models"
UNCOVERED = "the observer is certified for the set of models in left coprime factors, not for the set around the nominal unit"
_TOLERANCE_DB, _MAX_ORDER = 3.0, 2  # of shaping filters: of low order, to keep the search short


def design_for_models(task: DesignTask) -> DesignResult:
    """The worst-case observer for the units' rows in front of what they act on; of all nominals the one of least certified error."""
    data, in_h2 = task.training.read(), task.method == "worst_case_h2"
    found: dict[str, tuple[float, Array, Array, Synthesis, ModelDifferences, float | None]] = {}
    reasons = []
    for name, A, B in task.nominals:
        try:
            differences, problem = coprime_problem(task, data, A, B)
            synthesis = (worst_case_h2 if in_h2 else worst_case_hinf)(problem, tolerance_db=_TOLERANCE_DB, max_order=_MAX_ORDER)
        except SynthesisError as error:
            reasons.append(f"nominal {name}: {error}")
            continue
        ratio = unit_ratio(problem, differences, synthesis.controller, synthesis.worst_case_h2)
        value = synthesis.worst_case_h2 if in_h2 else synthesis.worst_case_hinf
        assert value is not None
        found[name] = value, A, B, synthesis, differences, ratio
    if not found:
        raise SynthesisError("Worst-case synthesis for models in left coprime factors: " + "; ".join(reasons))
    name = min(found, key=lambda key: found[key][0])
    _, A, B, synthesis, differences, ratio = found[name]
    facts: dict[str, Any] = {"set": MODELS, "nominal": name, "certified_cost": {key: row[0] for key, row in found.items()}}
    facts |= {"models_worst_case_h2": synthesis.worst_case_h2, "loop_gain": differences.loop_gain(A), "unit_to_bound_max": ratio}
    lifted = np.zeros((len(A) - synthesis.controller.n_outputs, synthesis.controller.n_inputs))
    K = synthesis.controller
    K = StateSpace(K.A, K.B, np.vstack([K.C, np.zeros((len(lifted), K.n_states))]), np.vstack([K.D, lifted]), K.dt)
    synthesis = replace(synthesis, controller=K)
    return DesignResult(task.name, task.observer(synthesis, A, B), synthesis, facts, task.problem, UNCOVERED)


def coprime_problem(task: DesignTask, data: ValidationSet, A: Array, B: Array) -> tuple[ModelDifferences, ObserverProblem]:
    """Return the differences between the units and a nominal, and the observer problem that they make."""
    models, batch, n, dt = task.models, data.batch, task.models.lifting.n_states, task.models.sample_period_s
    rows = [models.index(unit) for unit in task.covered]
    own = models.A[rows, :n], models.B[rows, :n]
    differences = ModelDifferences.of(A[:n], B[:n], own, task.covered, driven(task, data), dt, max_order=task.max_order)
    F = mean_error_dynamics(A, mean_slopes(models.lifting, batch.states, batch.inputs, batch.parameters))
    return differences, as_problem(differences, F, task.selector[:, :n], task.noise, task.settings.penalty)


def as_problem(differences: ModelDifferences, F: Array, C: Array, noise: Array, penalty: float = 1e-3) -> ObserverProblem:
    """Return the observer problem of a set of rows: the error dynamics F stand behind W_L, and an additive perturbation of the state is one of the rows."""
    (n, k), dt = differences.residuals.shape[-2:], differences.sample_period_s
    return ObserverProblem(
        nominal=StateSpace(F, np.zeros((n, k)), np.eye(n), np.zeros((n, k)), dt),
        C=C,
        W_L=StateSpace(F, np.eye(n), np.eye(n), np.zeros((n, n)), dt) @ differences.weight.left,
        W_R=differences.weight.right,
        input_scale=np.ones(k),
        output_scale=np.ones(n),
        noise=noise,
        correction_penalty=penalty,
        injection=Injection.STATE,
        form=Form.ADDITIVE,
    )


def driven(task: DesignTask, data: ValidationSet) -> BandEnergies:
    """Return the energies of ``[u; theta(x)]``, the mean over the units."""
    lifting, batch = task.models.lifting, data.batch
    x, u = np.swapaxes(batch.states, 0, 1), np.swapaxes(batch.inputs, 0, 1)
    values = {name: value[..., None] for name, value in batch.parameters.items()}
    window = lifting.windows(x, u)
    signal = np.concatenate([lifting.lift_inputs(u[:, lifting.history :], window, values), lifting.lift(window, values)], axis=-1)
    lengths = batch.lengths - lifting.history
    found = BandEnergies.of(np.swapaxes(signal, 0, 1), lengths, band_edges(int(lengths.max())))
    return replace(found, energy=found.of_units(batch.units).energy.mean(axis=0))


def unit_ratio(problem: ObserverProblem, differences: ModelDifferences, controller: StateSpace, bound: float | None) -> float | None:
    """Return the largest error of a unit's rows under the pooled spectrum over the certified one, by quadrature over bands; noise counts in both."""
    if bound is None:
        return None
    loop = problem.error_system(controller)
    n, k = problem.nominal.n_states, problem.nominal.n_inputs
    F = problem.scaled[0]
    z = np.exp(2j * np.pi * differences.sample_period_s * differences.freqs_hz)
    response = loop.frequency_response(differences.freqs_hz)
    T = response[..., k : k + n] @ np.linalg.inv(z[:, None, None] * np.eye(n) - F)
    squares = np.sum(np.abs(T @ differences.residuals) ** 2, axis=(-2, -1))
    width = np.diff(
        np.concatenate([[0.0], np.sqrt(differences.freqs_hz[1:] * differences.freqs_hz[:-1]), [0.5 / differences.sample_period_s]])
    )
    return float(np.sqrt((squares @ width).max() * 2 * differences.sample_period_s) / bound)
