"""The paper's own observer: its weights, entry by entry, in its mixed problem."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from ...core.lti import StateSpace, gain
from ...synthesis import Injection, ObserverProblem, mixed
from ...uncertainty import residual
from ...uncertainty.weights.entries import EntryWeights, fit_entries
from ..task import DesignResult, DesignTask


def design_published(task: DesignTask) -> DesignResult:
    """Mixed synthesis with a weight for every entry of the residual in front of a full perturbation, as in the paper's Figures 8 and 10."""
    problem = task.require_problem()
    weights = entry_weights(task)
    found = mixed(as_published(problem, weights.system), time_limit_s=task.settings.time_limit_s)
    excess = weights.excess
    note = f"The weights bound entries: they are exceeded {excess:.3g} times in front of a full perturbation."
    published = replace(found, method="paper", worst_case_h2=None, quadrature_error=None, notes=(*found.notes, note))
    return task.designed(published, unstructured_excess=excess)


def entry_weights(task: DesignTask) -> EntryWeights:
    """Return bounds of all entries of the residuals of the units that the study's own set covers."""
    models, units = task.models, list(task.covered)
    freqs = models.frequencies()
    responses = models.scaled_responses(freqs, units)
    E = residual(task.require_problem().form, responses[units.index(task.unit)], responses)
    return fit_entries(E, freqs, models.sample_period_s, task.max_order)


def as_published(problem: ObserverProblem, weight: StateSpace) -> ObserverProblem:
    """Return the problem with one matrix of weights, corrected through the input and without a remainder."""
    one = gain(np.eye(weight.n_inputs), weight.dt)
    return replace(problem, W_L=weight, W_R=one, remainder_left=None, remainder_right=None, injection=Injection.INPUT)
