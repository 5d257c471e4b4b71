"""One maker for each observer method: from a nominal model and an uncertain set to a verified `Synthesis`."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Any

import numpy as np
import numpy.typing as npt

from ..core.errors import SynthesisError
from ..core.lti import StateSpace, block_diagonal, gain
from ..identify import ModelSet
from ..observer import Observer, noise_covariances
from ..synthesis import Injection, ObserverProblem, Status, Synthesis, kalman, mixed, reduce_controller, worst_case_h2, worst_case_hinf
from ..synthesis.worst_case.causal import causal_h2
from ..uncertainty import fit_magnitude
from .gains import kalman_tuned, make_luenberger
from .predictor import make_memory
from .published import make_paper
from .residual_shaped import OwnModel, make_residual_h2
from .settings import PredictorSettings
from .validation import TuningSet, rank

Array = npt.NDArray[np.float64]
IDENTITY, TUNED = "identity", "tuned"
_CORNERS_HZ = (0.03, 1.0, 30.0)
_NOISES = ((0.0, 0.0), (1e-2, 0.0), (0.0, 1e-1), (0.0, 1.0))  # process, measurement


@dataclass(frozen=True, eq=False)
class Task:
    """Everything a worker needs for one observer.

    Everything is in channels divided by their ranges. `problem` is None where there is no usable uncertain set, and `refusal` says why; `noise` is the
    standard deviation of every measurement's noise, and `covered` names the units whose differences the set covers.
    """

    name: str
    method: str
    models: ModelSet
    unit: str
    problem: ObserverProblem | None
    refusal: str
    noise: Array
    tuning: TuningSet
    input_weight: float | str
    time_limit_s: float
    max_order: int
    max_states: int | None
    covered: tuple[str, ...] = ()
    memory: PredictorSettings = field(default_factory=PredictorSettings)
    tune: bool = False

    def observer(self, synthesis: Synthesis) -> Observer:
        """Return the observer as it runs, in channels divided by their ranges."""
        models, row = self.models, self.models.index(self.unit)
        own = synthesis if isinstance(synthesis, OwnModel) else None
        return Observer(
            name=self.name,
            lifting=models.lifting if own is None or own.lifting is None else own.lifting,
            A=models.A[row] if own is None or own.A is None else own.A,
            B=models.B[row] if own is None or own.B is None else own.B,
            measured=models.measured,
            inputs=models.recorded_inputs,
            controller=synthesis.controller,
            injection=synthesis.injection,
            sample_period_s=models.sample_period_s,
            parameters={name: float(values[row]) for name, values in models.parameters.items()},
            seen=self.tuning.seen,
            replaces=own is not None and own.replaces,
            internal=0 if own is None else own.internal,
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
            raise SynthesisError(self.refusal)
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


def make_mixed(task: Task) -> Made:
    """The paper's mixed H2/H-infinity problem on the reduced, regularised plant, corrected through the input."""
    problem = replace(task.require_problem(), injection=Injection.INPUT)
    return mixed(problem, time_limit_s=task.time_limit_s), {}, task.problem


def make_worst_case_h2(task: Task) -> Made:
    """Worst-case H2 in the surroundings asked for, or in those that do best on training episodes."""
    problem = task.require_problem()
    if task.input_weight != TUNED:
        surroundings = Surroundings(task.input_weight)
        assumed = surroundings.of(problem)
        return of_few_states(task, assumed, worst_case_h2(assumed, max_order=task.max_order)), surroundings.facts(), assumed
    rough = partial(worst_case_h2, tolerance_db=3.0, refinements=0, fit=remembering(fit_magnitude), causal=False)
    surroundings, _ = best_surroundings(task, problem, partial(rough, bounded=False, max_order=1))
    assumed = surroundings.of(problem)
    _, synthesis = best_design(
        task, [partial(rough, assumed, max_order=order) for order in (1, 2)]
    )  # order 2 in the search takes twice as long
    synthesis = replace(synthesis, causal_h2=causal_h2(assumed, synthesis.controller))
    return of_few_states(task, assumed, synthesis), surroundings.facts(), assumed


def of_few_states(task: Task, problem: ObserverProblem, synthesis: Synthesis) -> Synthesis:
    """Return the observer's filter with at most `max_states` states, polished at that order."""
    if task.max_states is None or synthesis.controller.n_states <= task.max_states:
        return synthesis
    small = reduce_controller(problem, synthesis, task.max_states, polished=True)
    return replace(small, causal_h2=causal_h2(problem, small.controller))


def make_worst_case_hinf(task: Task) -> Made:
    """Worst-case H-infinity in the surroundings asked for, or in those that do best on training episodes; of low order, to keep the search short."""
    problem, surroundings = task.require_problem(), Surroundings(IDENTITY)
    rough = partial(worst_case_hinf, max_order=2, tolerance_db=3.0, refinements=0, fit=remembering(fit_magnitude))
    if task.input_weight == TUNED:
        surroundings, _ = best_surroundings(task, problem, partial(rough, bounded=False))
    else:
        surroundings = Surroundings(task.input_weight)
    assumed = surroundings.of(problem)
    return rough(assumed), surroundings.facts(), assumed


def best_surroundings(
    task: Task, problem: ObserverProblem, design: Callable[[ObserverProblem], Synthesis]
) -> tuple[Surroundings, Synthesis]:
    """Return the surroundings whose observer does best on training episodes, and that observer.

    How the inputs are spread over frequency and how much white noise there is nobody knows beforehand; the process noise of the tuned
    Kalman filter is chosen on the same episodes and by the same rule.
    """
    tried = list(candidates(task.models.sample_period_s))
    best, synthesis = best_design(task, [partial(design, surroundings.of(problem)) for surroundings in tried])
    return tried[best], synthesis


def best_design(task: Task, designs: Sequence[Callable[[], Synthesis]]) -> tuple[int, Synthesis]:
    """Return which design does best on training episodes, and its observer.

    Raises
    ------
    SynthesisError
        The last reason, where none can be made.
    """
    made: dict[int, Synthesis] = {}
    reason = ""
    for number, design in enumerate(designs):
        try:
            made[number] = design()
        except SynthesisError as error:
            reason = str(error)
    if not made:
        raise SynthesisError(reason)
    limit, *errors = task.tuning.read().percent_of_all([task.observer(s) for s in (open_loop(task)[0], *made.values())])
    ranks = {number: rank(error, limit, task.models.measured) for number, error in zip(made, errors, strict=True)}
    best = min(ranks, key=lambda number: ranks[number])
    return best, made[best]


def remembering(fit: Callable[..., Any]) -> Callable[..., Any]:
    """Return a fit that remembers: candidates that differ in noise alone share their shaping filters."""
    known: dict[Any, Any] = {}

    def fitted(freqs_hz: Array, magnitude: Array, dt: float, **options: Any) -> Any:
        key = (freqs_hz.tobytes(), magnitude.tobytes(), dt, *sorted(options.items()))
        if key not in known:
            known[key] = fit(freqs_hz, magnitude, dt, **options)
        return known[key]

    return fitted


@dataclass(frozen=True)
class Surroundings:
    """What is assumed about the machine's surroundings.

    Parameters
    ----------
    input_weight : float or "identity"
        Corner of the low-pass spectrum of the scaled inputs in Hz, or white inputs as in the paper.
    process_noise, measurement_noise : float
        Standard deviation of white noise on every state and measurement per sample, as a share of the largest value; measurements have at least
        the noise that was found in the recordings.
    """

    input_weight: float | str = IDENTITY
    process_noise: float = 0.0
    measurement_noise: float = 0.0

    def of(self, problem: ObserverProblem) -> ObserverProblem:
        """Return the problem in these surroundings."""
        ranges = np.abs(problem.C) @ problem.output_scale
        noise = np.maximum(problem.noise, self.measurement_noise * ranges)
        problem = replace(problem, process_noise=self.process_noise * problem.output_scale, noise=noise)
        if self.input_weight == IDENTITY:
            return problem
        dt, m = problem.nominal.dt, problem.nominal.n_inputs
        pole = np.exp([[-2 * np.pi * float(self.input_weight) * dt]])
        lowpass = StateSpace(pole, 1 - pole, pole, 1 - pole, dt)
        return replace(problem, W_u=block_diagonal([lowpass] * m))

    def facts(self) -> dict[str, Any]:
        """Return them for the records."""
        corner = None if self.input_weight == IDENTITY else float(self.input_weight)
        return {"input_weight_hz": corner, "process_noise": self.process_noise, "measurement_noise": self.measurement_noise}


def candidates(sample_period_s: float) -> list[Surroundings]:
    """Return the surroundings that are tried."""
    corners: tuple[float | str, ...] = (IDENTITY, *(c for c in _CORNERS_HZ if c < 0.25 / sample_period_s))
    return [Surroundings(corner, *noise) for corner in corners for noise in _NOISES]


MAKERS: dict[str, Callable[[Task], Made]] = {
    "worst_case_h2": make_worst_case_h2,
    "worst_case_hinf": make_worst_case_hinf,
    "mixed": make_mixed,
    "paper": make_paper,
    "residual_h2": make_residual_h2,
    "memory": make_memory,
    "open_loop": open_loop,
    "kalman_white": kalman_white,
    "kalman_tuned": kalman_tuned,
    "luenberger": make_luenberger,
}
