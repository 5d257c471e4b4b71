"""Methods for the uncertain set: worst-case H2, and the paper's mixed problem."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np
import numpy.typing as npt

from ...core.errors import SynthesisError
from ...synthesis import Injection, ObserverProblem, Synthesis, mixed, worst_case_h2
from ...uncertainty import fit_magnitude
from ..task import DesignResult, DesignTask, first_of
from .disturbance_model import TUNED, DisturbanceModel, candidates

Array = npt.NDArray[np.float64]


def design_mixed(task: DesignTask) -> DesignResult:
    """The paper's mixed H2/H-infinity problem on the reduced, regularised plant, corrected through the input."""
    problem = replace(task.require_problem(), injection=Injection.INPUT)
    return task.designed(mixed(problem, time_limit_s=task.settings.time_limit_s))


def design_worst_case_h2(task: DesignTask) -> DesignResult:
    """Worst-case H2 with the disturbance model asked for, or the one that does best on training episodes."""
    problem, wanted = task.require_problem(), task.settings.input_weight
    if wanted != TUNED:
        model = DisturbanceModel(wanted)
        assumed = model.of(problem)
        return task.designed(worst_case_h2(assumed, max_order=task.max_order), assumed, **model.facts())
    rough = partial(worst_case_h2, tolerance_db=3.0, fit=cached(fit_magnitude))
    model = best_model(task, problem, partial(rough, bounded=False, max_order=1))
    assumed = model.of(problem)
    _, synthesis = best_design(
        task, [partial(rough, assumed, max_order=order) for order in (1, 2)]
    )  # order 2 in the search takes twice as long
    return task.designed(synthesis, assumed, **model.facts())


def best_model(
    task: DesignTask, problem: ObserverProblem, design: Callable[[ObserverProblem], Synthesis]
) -> DisturbanceModel:
    """Return the disturbance model whose observer does best on training episodes, as the process noise of the tuned Kalman filter is chosen."""
    tried = candidates(task.models.sample_period_s)
    return tried[best_design(task, [partial(design, model.of(problem)) for model in tried])[0]]


def best_design(task: DesignTask, designs: Sequence[Callable[[], Synthesis]]) -> tuple[int, Synthesis]:
    """Return which design does best on training episodes, and its synthesis."""
    made: dict[int, Synthesis] = {}
    reason = ""
    for number, design in enumerate(designs):
        try:
            made[number] = design()
        except SynthesisError as error:
            reason = str(error)
    if not made:
        raise SynthesisError(reason)
    best = list(made)[first_of(task.ranked([task.observer(s) for s in made.values()]))]
    return best, made[best]


def cached(fit: Callable[..., Any]) -> Callable[..., Any]:
    """Return a fit that keeps its results: candidates that differ in noise alone share their shaping filters."""
    known: dict[Any, Any] = {}

    def fitted(freqs_hz: Array, magnitude: Array, dt: float, **options: Any) -> Any:
        key = (freqs_hz.tobytes(), magnitude.tobytes(), dt, *sorted(options.items()))
        if key not in known:
            known[key] = fit(freqs_hz, magnitude, dt, **options)
        return known[key]

    return fitted
