"""What the uncertain set says about an observer, however it was designed."""

from __future__ import annotations

import logging
from dataclasses import replace
from typing import Any

import numpy as np
import numpy.typing as npt

from ..core.errors import SynthesisError
from ..core.lti import StateSpace, gain
from ..identify import ModelSet
from ..observer import Observer
from ..observer.estimator.certificate import linear_estimate
from ..synthesis import ObserverProblem
from ..synthesis.worst_case.certificate import attained, certify_errors
from ..synthesis.worst_case.unit_check import unit_ratios
from ..uncertainty import UncertainModel
from .task import FITTED, Design, DesignTask

log = logging.getLogger(__name__)
Array = npt.NDArray[np.float64]


def usable_problem(models: ModelSet, uncertain: UncertainModel, noise: Array) -> tuple[ObserverProblem | None, str]:
    """Return the synthesis problem of one kind of model, or None and why there is none."""
    try:
        problem = ObserverProblem.from_uncertain(models, uncertain, noise)
        problem.require_sound()
        return problem, ""
    except SynthesisError as error:
        log.warning("%s: there are no robust observers and no certificates: %s", models.name, error)
        return None, str(error)


def certificate(task: DesignTask, design: Design, problem: ObserverProblem | None) -> dict[str, Any]:
    """Return what holds for an observer on every member of the set, and whether it holds for every unit's model."""
    observer = design.observer
    order = observer.controller.n_states + observer.lifting.n_states - len(observer.recorded)
    facts: dict[str, Any] = {"order": order, "spectral_radius_max": None, "worst_case_h2": None}
    if design.facts.get("rows_fitted_to_single_steps"):
        return facts | {"reason": FITTED}
    if problem is None:
        return facts | {"reason": task.refusal}
    problem = replace(problem, injection=design.synthesis.injection)
    try:
        errors, mean = error_maps(task, design, problem)
        facts["spectral_radius_max"] = float(max(errors.spectral_radius(), task.models.spectral_radius().max()))
        bound = certify_errors(problem, errors, mean)[0]
        if observer.bank is None:
            facts |= of_units(task, design, problem)
        else:
            facts["constant_h2"] = float(np.linalg.norm(mean))
            facts["worst_case_h2_attained"] = attained(problem, errors, mean)
            require_useful(problem, observer, bound)
        return facts | {"worst_case_h2": bound}
    except SynthesisError as error:
        log.warning("%s: no certificate, %s", task.name, error)
        return facts | {"reason": str(error)}


def require_useful(problem: ObserverProblem, observer: Observer, bound: float) -> None:
    """Refuse a bound that is no better than that of no estimate: the set does not relate inputs as recordings do."""
    columns = len(observer.measured) + problem.nominal.n_outputs + problem.nominal.n_inputs
    nothing = gain(np.zeros((problem.nominal.n_outputs, columns)), problem.nominal.dt)
    without = certify_errors(problem, problem.estimate_error(nothing), np.zeros(1))[0]
    if bound >= without:
        both = f"the bound of the set is {bound:.3g} and that of no estimate {without:.3g}"
        raise SynthesisError(f"{both}: the inputs of the set are independent, recorded ones are not.")


def error_maps(task: DesignTask, design: Design, problem: ObserverProblem) -> tuple[StateSpace, Array]:
    """Return the system from what drives plants of the set to the weighted error of an observer, and the mean error."""
    if design.observer.bank is None:
        return problem.error_system(design.synthesis.controller), np.zeros(1)
    estimate, mean = linear_estimate(design.observer, task.models.lifting, design.facts["outside_models_percent"])
    weight = problem.performance.frequency_response([0.0])[0].real
    return problem.estimate_error(estimate), weight @ (mean / problem.output_scale)


def of_units(task: DesignTask, design: Design, problem: ObserverProblem) -> dict[str, Any]:
    """Return whether the bound holds for the models of all units."""
    ratios = unit_ratios(problem, design.synthesis.controller, task.models.systems(task.covered))
    of_norm, of_density = (float(ratio.max(initial=0.0)) for ratio in ratios)
    if of_norm > 1:
        log.warning("%s: the error of a unit's model is %.3g times its certified bound", task.name, of_norm)
    return {"bound_holds": of_norm <= 1, "unit_to_h2_bound_max": of_norm, "unit_to_density_max": of_density}
