"""What every method of observer design gets, and what it returns."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import numpy.typing as npt

from ..core.errors import SynthesisError
from ..core.lti import gain
from ..identify import ModelSet
from ..lifting import Lifting
from ..observer import EstimatorSettings, Observer, Runtime
from ..observer.sensor import Limits, Sensors, delay_of, sides
from ..synthesis import Injection, ObserverProblem, Status, Synthesis
from .settings import SynthesisSettings
from .validation import TrainingSet, rank

Array = npt.NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class DesignTask:
    """One observer to design, in channels divided by their ranges."""

    name: str
    method: str
    models: ModelSet
    unit: str
    problem: ObserverProblem | None
    refusal: str
    noise: Array  # (q,)
    training: TrainingSet
    covered: tuple[str, ...] = ()
    max_order: int = 4
    settings: SynthesisSettings = field(default_factory=SynthesisSettings)
    estimator: EstimatorSettings = field(default_factory=EstimatorSettings)
    limits: Limits = field(default_factory=dict)
    pooled: bool = True
    recordings: TrainingSet | None = None

    def observer(
        self, synthesis: Synthesis, A: Array | None = None, B: Array | None = None, lifting: Lifting | None = None
    ) -> Observer:
        """Return the observer of a synthesis, with the nominal model or another one."""
        models, row = self.models, self.models.index(self.unit)
        return Observer(
            name=self.name,
            lifting=models.lifting if lifting is None else lifting,
            A=models.A[row] if A is None else A,
            B=models.B[row] if B is None else B,
            measured=models.measured,
            inputs=models.recorded_inputs,
            controller=synthesis.controller,
            injection=synthesis.injection,
            sample_period_s=models.sample_period_s,
            parameters={name: float(values[row]) for name, values in models.parameters.items()},
            runtime=self.runtime,
            seen=self.training.seen,
            sensor=self.sensor,
        )

    def designed(self, synthesis: Synthesis, problem: ObserverProblem | None = None, **facts: Any) -> DesignResult:
        """Return the result of a method that corrects the nominal model; `problem` is the set that it was designed for, else the task's."""
        return DesignResult(
            self.name, self.observer(synthesis), synthesis, facts, self.problem if problem is None else problem
        )

    @property
    def nominals(self) -> tuple[tuple[str, Array, Array], ...]:
        """Names and models that may be the nominal: the unit, and the mean over the covered units."""
        models, rows = self.models, [self.models.index(unit) for unit in self.covered]
        unit = (self.unit, models.A[models.index(self.unit)], models.B[models.index(self.unit)])
        return (
            (unit, ("mean", models.A[rows].mean(axis=0), models.B[rows].mean(axis=0)))
            if self.pooled and rows
            else (unit,)
        )

    @property
    def sensor(self) -> Sensors:
        """What is declared of the sensors of measured states, by name, in the task's channels."""
        return self.training.sensor

    @property
    def runtime(self) -> Runtime:
        """What observers have to know of the machine: that measurements arrive late, and its limits, which cut off estimates."""
        lower, upper = sides(self.limits, self.models.lifting.states) if self.limits else (None, None)
        return Runtime(delay_of(self.sensor), lower, upper)

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

    def open_loop(self) -> Observer:
        """Return the nominal model without correction."""
        return self.observer(without_correction(self))

    def ranked(self, observers: Sequence[Observer]) -> list[tuple[bool, float]]:
        """Return the rank of every observer on the training episodes, see `validation.rank`; least is best."""
        limit, *errors = self.training.read().percent_of_all([self.open_loop(), *observers])
        return [rank(error, limit, self.models.measured) for error in errors]


@dataclass(frozen=True, eq=False)
class DesignResult:
    """One observer in channels divided by their ranges, or the reason why there is none."""

    name: str
    observer: Observer | None
    synthesis: Synthesis | None
    facts: dict[str, Any]
    problem: ObserverProblem | None = None
    uncovered: str = ""


def without_correction(task: DesignTask) -> Synthesis:
    """Return the synthesis that corrects nothing."""
    controller = gain(np.zeros((task.models.lifting.n_lifted, len(task.models.measured))), task.models.sample_period_s)
    return Synthesis("open_loop", controller, Status.OPTIMAL, Injection.STATE)


def first_of(ranks: Sequence[tuple[bool, float]]) -> int:
    """Return which rank is the least, the first of equal ones."""
    return min(range(len(ranks)), key=lambda i: ranks[i])


def is_robust(facts: Mapping[str, Any]) -> bool:
    """Tell from the facts about an observer whether it is certified for a set of machines: that around the nominal, or the one that it was designed for."""
    if facts.get("set") == "signals":
        return bool(facts.get("set_certified"))
    return facts.get("worst_case_h2") is not None


def split_name(observer: str) -> tuple[str, str]:
    """Return kind of model and method of an observer's name; what has no model has an empty kind."""
    kind, _, method = observer.rpartition("/")
    return kind, method
