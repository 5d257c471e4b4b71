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
from ..uncertainty import fit_magnitude
from .tuning import TuningSet

Array = npt.NDArray[np.float64]
IDENTITY, TUNED = "identity", "tuned"
_MIXED_NOISE = 1e-3  # of the range; matrix inequalities do not resolve an encoder's 1e-7
_CORNERS_HZ = (1.0, 3.0, 10.0, 30.0, 100.0)
_PROCESS_NOISE = (0.0, 1e-2, 1e-1)


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
    """Worst-case H2 for the input weight asked for, or for the input weight and process noise that do best on training episodes.

    Both are assumptions about the machine's surroundings that nobody knows beforehand, like the process noise of the tuned Kalman filter,
    which is chosen on the same episodes. A candidate counts only if it does not spoil the measured states.
    """
    problem = task.require_problem()
    if task.input_weight != TUNED:
        assumed = assume(problem, task.input_weight, 0.0)
        return worst_case_h2(assumed, max_order=task.max_order), {"input_weight_hz": _corner(task.input_weight)}, assumed
    judge, fit = task.tuning.read(), remembering(fit_magnitude)
    limit = judge.percent(task.observer(open_loop(task)[0]))
    best: tuple[tuple[bool, float], float | str, float, Synthesis] | None = None
    for weight in (c for c in (IDENTITY, *_CORNERS_HZ) if c == IDENTITY or float(c) < 0.25 / task.models.sample_period_s):
        for noise in _PROCESS_NOISE:
            synthesis = worst_case_h2(assume(problem, weight, noise), max_order=2, tolerance_db=3.0, refinements=0, fit=fit)
            verdict = rank(judge.percent(task.observer(synthesis)), limit, list(task.models.measured))
            if best is None or verdict < best[0]:
                best = (verdict, weight, noise, synthesis)
    assert best is not None
    _, weight, noise, synthesis = best
    assumed = assume(problem, weight, noise)
    accurate = worst_case_h2(assumed, max_order=task.max_order)  # of higher order: for its lower bound
    lower = max((b for b in (synthesis.lower_bound, accurate.lower_bound) if b is not None), default=None)
    gap = None if lower is None or synthesis.worst_case_h2 is None else 100 * (synthesis.worst_case_h2 / lower - 1)
    facts = {"input_weight_hz": _corner(weight), "process_noise": noise}
    return replace(synthesis, lower_bound=lower, gap_percent=gap), facts, assumed


def rank(percent: Array, limit: Array, measured: list[int]) -> tuple[bool, float]:
    """Order candidates: first those whose measured states are no worse than in open loop, by the mean error of the hidden ones."""
    excess = float(np.max(percent[measured] / limit[measured]))
    if excess > 1 or len(measured) == len(percent):
        return excess > 1, excess
    return False, float(np.mean(np.delete(percent, measured)))


def remembering(fit: Callable[..., Any]) -> Callable[..., Any]:
    """Return a fit that remembers: candidates that differ in noise alone share their shaping filters."""
    known: dict[Any, Any] = {}

    def fitted(freqs_hz: Array, magnitude: Array, dt: float, **options: Any) -> Any:
        key = (freqs_hz.tobytes(), magnitude.tobytes(), dt, *sorted(options.items()))
        if key not in known:
            known[key] = fit(freqs_hz, magnitude, dt, **options)
        return known[key]

    return fitted


def _corner(weight: float | str) -> float | None:
    return None if weight == IDENTITY else float(weight)


def assume(problem: ObserverProblem, weight: float | str, process_noise: float) -> ObserverProblem:
    """Return the problem under assumptions about its surroundings.

    Parameters
    ----------
    problem : ObserverProblem
    weight : float or "identity"
        Corner of the low-pass spectrum of the scaled inputs in Hz, or white inputs as in the paper.
    process_noise : float
        Standard deviation of white noise on every state and sample, as a share of its range.
    """
    if process_noise:
        problem = replace(problem, process_noise=process_noise * problem.output_scale)
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
