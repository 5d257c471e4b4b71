"""Methods for the uncertain set: worst-case H2, the paper's mixed problem, and that with the paper's own weights."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
from itertools import product

import numpy as np

from ... import synthesis  # solvers load when they are used
from ...core import Record, StateSpace, SynthesisError, block_diagonal, frozen, gain
from ...identify.model_set import EDMD
from ...synthesis import Injection, ObserverProblem, Synthesis
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
        return task.designed(synthesis.mixed(problem, steps=self.steps))


@frozen
class Published(Mixed):
    """The mixed problem with a weight for every entry of the residual, as in the paper's Figures 8 and 10."""

    name = "paper"
    label = Label("mixed, entrywise weights", "as published", "ORANGE")
    max_order: int = 4  # of the weight of an entry

    def design(self, task: DesignTask) -> Design:
        """Solve the published problem; its weights bound entries: its own norms are none of the set."""
        weights = self.weights(task)
        solved = synthesis.mixed(as_published(task.require_problem(), weights.system), steps=self.steps)
        note = f"The weights bound entries: a full perturbation exceeds them {weights.excess:.3g} times."
        nothing: Record = {"worst_case_h2": None, "quadrature_error": None}
        published = replace(solved, method=self.name, notes=(*solved.notes, note), **nothing)
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
class Disturbances:
    """What is assumed about the disturbances of a machine."""

    corner: float | None = None  # of the inputs' low-pass spectrum, share of the sampling frequency; None: white inputs
    process_noise: float = 0.0  # share of every state's range
    measurement_noise: float = 0.0  # share of every measurement's range, at least

    def of(self, problem: ObserverProblem) -> ObserverProblem:
        """Return the problem with these disturbances."""
        noise = np.maximum(problem.noise, self.measurement_noise * np.abs(problem.C) @ problem.output_scale)
        problem = replace(problem, process_noise=self.process_noise * problem.output_scale, noise=noise)
        if self.corner is None:
            return problem
        pole = np.exp([[-2 * np.pi * self.corner]])
        lowpass = StateSpace(pole, 1 - pole, pole, 1 - pole, problem.nominal.dt)
        return replace(problem, W_u=block_diagonal([lowpass] * problem.nominal.n_inputs))

    def facts(self, dt: float) -> Record:
        """Return them for the metrics."""
        hz = None if self.corner is None else self.corner / dt
        return {"input_weight_hz": hz, "process_noise": self.process_noise, "measurement_noise": self.measurement_noise}


@frozen
class WorstCaseH2(Method):
    """Worst-case H2 with the disturbances whose observer does best on training episodes."""

    name = "worst_case_h2"
    label = Label("worst-case H2", "smallest H2 norm over the set of plants", "BLUE")
    assumes_disturbances = True
    corners: tuple[float | None, ...] = (None, 3e-5, 1e-3)  # see `Disturbances`
    noises: tuple[tuple[float, float], ...] = ((0.0, 0.0), (1e-2, 0.0), (0.0, 1e-1), (0.0, 1.0))
    tolerance_db: float = 3.0  # of the shaping filters
    orders: tuple[int, ...] = (1, 2)  # of the shaping filters; disturbances are compared with the first one

    def design(self, task: DesignTask) -> Design:
        """Choose disturbances, then the order, on training episodes."""
        problem = task.require_problem()
        solve = partial(synthesis.worst_case_h2, tolerance_db=self.tolerance_db)
        tried = [Disturbances(corner, *noise) for corner, noise in product(self.corners, self.noises)]
        rough = [partial(solve, d.of(problem), bounded=False, max_order=self.orders[0]) for d in tried]
        disturbances = tried[best_design(task, rough)[0]]
        assumed = disturbances.of(problem)
        _, best = best_design(task, [partial(solve, assumed, max_order=order) for order in self.orders])
        return task.designed(best, assumed, **disturbances.facts(problem.nominal.dt))


def best_design(task: DesignTask, designs: Sequence[Callable[[], Synthesis]]) -> tuple[int, Synthesis]:
    """Return which design does best on training episodes, and its synthesis."""
    solved, reason = dict[int, Synthesis](), ""
    for number, design in enumerate(designs):
        try:
            solved[number] = design()
        except SynthesisError as error:
            reason = str(error)
    if not solved:
        raise SynthesisError(reason)
    best = list(solved)[task.best([task.observer(one) for one in solved.values()])[0]]
    return best, solved[best]
