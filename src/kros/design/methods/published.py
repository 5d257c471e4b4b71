"""The paper's own observer: its weights, entry by entry, in its mixed problem."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from ...core.lti import StateSpace, gain
from ...synthesis import Injection, ObserverProblem, mixed
from ...uncertainty import quantify
from ...uncertainty.weights.weight import EntrywiseWeight
from ..task import DesignResult, DesignTask


def design_published(task: DesignTask) -> DesignResult:
    """Mixed synthesis with a weight for every entry of the residual in front of a full perturbation, as in the paper's Figures 8 and 10."""
    problem = task.require_problem()
    weight = entrywise_weight(task)
    found = mixed(as_published(problem, weight.matrix()), time_limit_s=task.settings.time_limit_s)
    excess = weight.unstructured_excess
    note = f"The weights bound entries: they are exceeded {excess:.3g} times in front of a full perturbation."
    published = replace(found, method="paper", worst_case_h2=None, quadrature_error=None, notes=(*found.notes, note))
    return task.designed(published, unstructured_excess=excess)


def entrywise_weight(task: DesignTask) -> EntrywiseWeight:
    """Return bounds of all entries of the residuals of the units that the study's own set covers."""
    models = task.models
    found = quantify(
        models.systems(task.covered),
        task.require_problem().form,
        unit_ids=task.covered,
        output_scale=models.output_scale,
        input_scale=models.input_scale,
        nominal=task.unit,
        structure="entrywise",
        max_order=task.max_order,
    )
    assert isinstance(found.weight, EntrywiseWeight)
    return found.weight


def as_published(problem: ObserverProblem, weight: StateSpace) -> ObserverProblem:
    """Return the problem with one matrix of weights, corrected through the input and without a remainder."""
    one = gain(np.eye(weight.n_inputs), weight.dt)
    return replace(problem, W_L=weight, W_R=one, remainder_left=None, remainder_right=None, injection=Injection.INPUT)
