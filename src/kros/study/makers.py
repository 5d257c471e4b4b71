"""One maker for each observer method: from a nominal model and an uncertain set to a verified `Synthesis`."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import numpy.typing as npt

from ..core.errors import SynthesisError
from ..core.lti import StateSpace, block_diagonal, gain
from ..identify import ModelSet
from ..observer import Observer, kalman_candidates, noise_covariances
from ..synthesis import Injection, ObserverProblem, Status, Synthesis, kalman, mixed, worst_case_h2
from .tuning import TuningSet

Array = npt.NDArray[np.float64]
IDENTITY, TUNED = "identity", "tuned"
_MIXED_NOISE = 1e-3  # of the range; matrix inequalities do not resolve an encoder's 1e-7
_CORNERS_HZ = (1.0, 3.0, 10.0, 30.0, 100.0)


@dataclass(frozen=True, eq=False)
class Task:
    """Everything a worker needs for one observer.

    `problem` is None where there is no uncertain set; `noise` is the standard deviation of every measurement's noise.
    """

    name: str
    method: str
    models: ModelSet
    unit: str
    problem: ObserverProblem | None
    noise: Array
    tuning: TuningSet
    input_weight: float | str
    time_limit_s: float
    max_order: int

    def observer(self, synthesis: Synthesis) -> Observer:
        """Return the observer as it runs."""
        models, row = self.models, self.models.index(self.unit)
        return Observer(
            name=self.name,
            lifting=models.lifting,
            A=models.A[row],
            B=models.B[row],
            measured=models.measured,
            inputs=models.inputs,
            controller=synthesis.controller,
            injection=synthesis.injection,
            sample_period_s=models.sample_period_s,
            parameters={name: float(values[row]) for name, values in models.parameters.items()},
        )

    @property
    def dynamics(self) -> Array:
        """Dynamics of the nominal unit."""
        return self.models.A[self.models.index(self.unit)]

    @property
    def selector(self) -> Array:
        """Selects the measured states."""
        return np.eye(self.models.lifting.n_lifted)[list(self.models.measured)]

    def require_problem(self) -> ObserverProblem:
        """Return the uncertain set, or say that there is none."""
        if self.problem is None:
            raise SynthesisError(f"{self.name}: needs an uncertain set, and the uncertainty stage made none.")
        return self.problem


@dataclass(frozen=True, eq=False)
class Product:
    """One observer, or the reason why there is none; `problem` is the set it was certified for."""

    name: str
    synthesis: Synthesis | None
    facts: dict[str, Any]
    problem: ObserverProblem | None


Made = tuple[Synthesis, dict[str, Any], ObserverProblem | None]


def produce(task: Task) -> Product:
    """Make one observer; a failure is a product too, with its reason."""
    try:
        synthesis, facts, problem = MAKERS[task.method](task)
    except SynthesisError as error:
        return Product(task.name, None, {"status": "failed", "reason": str(error)}, task.problem)
    return Product(task.name, synthesis, facts, problem)


def open_loop(task: Task) -> Made:
    """The nominal model without correction."""
    controller = gain(np.zeros((task.models.lifting.n_lifted, len(task.models.measured))), task.models.sample_period_s)
    return Synthesis("open_loop", controller, Status.OPTIMAL, Injection.STATE), {}, task.problem


def kalman_white(task: Task) -> Made:
    """Kalman gains for noise guessed as anybody would: one-step residuals and quantisation."""
    Q, R = noise_covariances(task.models.residual_covariance, task.noise * np.sqrt(12))
    return kalman(task.dynamics, task.selector, Q, R, task.models.sample_period_s), {}, task.problem


def kalman_tuned(task: Task) -> Made:
    """Kalman gains for the white process noise that does best on training episodes."""
    judge = task.tuning.read()
    candidates = kalman_candidates(
        task.dynamics, task.selector, task.models.output_scale, np.diag(task.noise**2), task.models.sample_period_s
    )
    scored = [(judge.hidden_percent(task.observer(synthesis)), level, synthesis) for level, synthesis in candidates]
    error, level, best = min(scored, key=lambda row: row[0])
    if not np.isfinite(error):
        raise SynthesisError("Tuned Kalman filter: every candidate diverges on the training episodes.")
    return best, {"process_noise_level": level, "training_error_percent": error}, task.problem


def make_mixed(task: Task) -> Made:
    """The paper's mixed H2/H-infinity problem on the reduced, regularised plant, corrected through the input."""
    problem = task.require_problem()
    ranges = problem.C @ problem.output_scale
    problem = replace(problem, injection=Injection.INPUT, noise=np.maximum(problem.noise, _MIXED_NOISE * np.abs(ranges)))
    synthesis = mixed(problem.mixed_plant(), time_limit_s=task.time_limit_s)
    return replace(synthesis, controller=problem.to_physical(synthesis.controller), injection=Injection.INPUT), {}, task.problem


def make_worst_case_h2(task: Task) -> Made:
    """Worst-case H2 for the input weight asked for, or for the one that does best on training episodes."""
    problem = task.require_problem()
    if task.input_weight != TUNED:
        weighted = weigh_inputs(problem, task.input_weight)
        return worst_case_h2(weighted, max_order=task.max_order), {"input_weight_hz": _corner(task.input_weight)}, weighted
    judge = task.tuning.read()
    limit = judge.percent(task.observer(open_loop(task)[0]))
    measured = list(task.models.measured)
    candidates = []
    for weight in (IDENTITY, *(c for c in _CORNERS_HZ if c < 0.25 / task.models.sample_period_s)):
        weighted = weigh_inputs(problem, weight)
        synthesis = worst_case_h2(weighted, max_order=2, tolerance_db=3.0, refinements=0)
        percent = judge.percent(task.observer(synthesis))
        excess = float(np.max(percent[measured] / limit[measured]))
        hidden = float(np.mean(np.delete(percent, measured))) if len(measured) < len(percent) else excess
        candidates.append(((excess > 1, hidden if excess <= 1 else excess), weight))
    weight = min(candidates, key=lambda row: row[0])[1]
    weighted = weigh_inputs(problem, weight)
    return worst_case_h2(weighted, max_order=task.max_order), {"input_weight_hz": _corner(weight)}, weighted


def _corner(weight: float | str) -> float | None:
    return None if weight == IDENTITY else float(weight)


def weigh_inputs(problem: ObserverProblem, weight: float | str) -> ObserverProblem:
    """Return the problem with scaled inputs of low-pass spectrum, corner in Hz, or white ones, as in the paper."""
    if weight == IDENTITY:
        return problem
    dt, m = problem.nominal.dt, problem.nominal.n_inputs
    pole = float(np.exp(-2 * np.pi * float(weight) * dt))
    lowpass = StateSpace([[pole]], [[1 - pole]], [[pole]], [[1 - pole]], dt)
    return replace(problem, W_u=block_diagonal([lowpass] * m))


MAKERS: dict[str, Callable[[Task], Made]] = {
    "worst_case_h2": make_worst_case_h2,
    "mixed": make_mixed,
    "open_loop": open_loop,
    "kalman_white": kalman_white,
    "kalman_tuned": kalman_tuned,
}
