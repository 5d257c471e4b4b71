"""Methods for the uncertain set: worst-case H2, the paper's mixed problem, and that with the paper's own weights."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from ...core import StateSpace, frozen, gain
from ...identify.model_set import EDMD
from ...synthesis import Injection, ObserverProblem, mixed, worst_case_h2
from ...uncertainty import residual
from ...uncertainty.unit_residuals import EntryWeights, fit_entries
from ..task import Design, DesignTask, Label, Method


@frozen
class Mixed(Method):
    """The paper's mixed H2/H-infinity problem on the reduced, regularised plant, corrected through the input."""

    name = "mixed"
    label = Label("mixed H2-H∞", "H2-optimal with an H∞ bound", "ORANGE")
    steps: int = 400  # of the optimisation, at most

    def refusal(self, kind: str) -> str:
        """Refuse refined models: the correction is spent on lifted modes that the nonlinear observer does not have."""
        return "" if kind.endswith(EDMD) else "it is for the paper's models; set identify.refine = false"

    def design(self, task: DesignTask) -> Design:
        """Solve the mixed problem."""
        problem = replace(task.require_problem(), injection=Injection.INPUT)
        return task.designed(mixed(problem, steps=self.steps))


@frozen
class Published(Mixed):
    """The mixed problem with a weight for every entry of the residual, as in the paper's Figures 8 and 10."""

    name = "paper"
    label = Label("mixed, entrywise weights", "as published", "ORANGE")
    max_order: int = 4  # of the weight of an entry

    def design(self, task: DesignTask) -> Design:
        """Solve the published problem; its weights bound entries: its own norms are none of the set."""
        weights = self.weights(task)
        solved = mixed(as_published(task.require_problem(), weights.system), steps=self.steps)
        note = f"The weights bound entries: a full perturbation exceeds them {weights.excess:.3g} times."
        published = replace(solved, method=self.name, notes=(*solved.notes, note), worst_case_h2=None)
        return task.designed(published, unstructured_excess=weights.excess)

    def weights(self, task: DesignTask) -> EntryWeights:
        """Return bounds of all entries of the residuals of the units that the study's own set covers."""
        models, units = task.models, list(task.covered)
        freqs = models.frequencies()
        responses = models.scaled_responses(freqs, units)
        E = residual(task.require_problem().form, responses[units.index(task.unit)], responses)
        return fit_entries(E, freqs, models.sample_period_s, self.max_order)


def as_published(problem: ObserverProblem, weight: StateSpace) -> ObserverProblem:
    """Return the problem with one matrix of weights, corrected through the input and without a remainder."""
    one = gain(np.eye(weight.n_inputs), weight.dt)
    return replace(problem, W_L=weight, W_R=one, remainder_left=None, remainder_right=None, injection=Injection.INPUT)


@frozen
class WorstCaseH2(Method):
    """Worst-case H2 for white inputs and the declared noise."""

    name = "worst_case_h2"
    label = Label("worst-case H2", "smallest H2 norm over the set of plants", "BLUE")
    tolerance_db: float = 3.0  # of the shaping filters
    max_order: int = 2  # of each shaping filter

    def design(self, task: DesignTask) -> Design:
        """Design it for the uncertain set."""
        problem = task.require_problem()
        return task.designed(worst_case_h2(problem, max_order=self.max_order, tolerance_db=self.tolerance_db))
