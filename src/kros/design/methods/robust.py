"""Methods for the uncertain set: worst-case H2, the paper's mixed problem, and that with the paper's own weights."""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass, replace
from typing import Any, ClassVar

import numpy as np

from ... import synthesis  # solvers load when they are used
from ...core.lti import StateSpace, gain
from ...identify.model_set import kind_of
from ...synthesis import Injection, ObserverProblem
from ...uncertainty import residual
from ...uncertainty.weights.entries import EntryWeights, fit_entries
from ..task import Design, DesignTask, Method


@dataclass(frozen=True)
class Mixed(Method):
    """The paper's mixed H2/H-infinity problem on the reduced, regularised plant, corrected through the input."""

    name: ClassVar[str] = "mixed"
    time_limit_s: float = 60.0  # of the optimisation

    def refusal(self, kind: str, kinds: Collection[str]) -> str:
        """Refuse refined models."""
        lifted = "the paper's problem spends its correction on lifted modes that the nonlinear observer does not have"
        return lifted if kind_of(kind).refined else ""

    def design(self, task: DesignTask) -> Design:
        """Solve the mixed problem."""
        problem = replace(task.require_problem(), injection=Injection.INPUT)
        return task.designed(synthesis.mixed(problem, time_limit_s=self.time_limit_s))


@dataclass(frozen=True)
class Published(Mixed):
    """The mixed problem with a weight for every entry of the residual, as in the paper's Figures 8 and 10."""

    name: ClassVar[str] = "paper"
    max_order: int = 4  # of the weight of an entry

    def design(self, task: DesignTask) -> Design:
        """Solve the published problem; its weights bound entries, not a full perturbation, so nothing is certified."""
        weights = self.weights(task)
        solved = synthesis.mixed(as_published(task.require_problem(), weights.system), time_limit_s=self.time_limit_s)
        excess = weights.excess
        note = f"The weights bound entries: they are exceeded {excess:.3g} times in front of a full perturbation."
        notes = (*solved.notes, note)
        published = replace(solved, method=self.name, worst_case_h2=None, quadrature_error=None, notes=notes)
        return task.designed(published, unstructured_excess=excess)

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


@dataclass(frozen=True)
class WorstCaseH2(Method):
    """The least worst-case H2 error over the set, for white inputs and the noise of the measurements."""

    name: ClassVar[str] = "worst_case_h2"
    max_order: int = 2  # of a shaping filter
    tolerance_db: float = 3.0  # of the shaping filters: it costs optimality, never validity

    def design(self, task: DesignTask) -> Design:
        """Design for the average spectrum of the set; no correction where that has the smaller worst case."""
        options: dict[str, Any] = {"max_order": self.max_order, "tolerance_db": self.tolerance_db}
        return task.designed(synthesis.worst_case_h2(task.require_problem(), **options))
