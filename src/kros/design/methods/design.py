"""From a task to an observer, by the method that it names."""

from __future__ import annotations

from collections.abc import Callable

from ...core.errors import SynthesisError
from ..task import DesignResult, DesignTask
from .estimator import design_estimator
from .gains import design_kalman_tuned, design_open_loop
from .published import design_published
from .residual_shaped import design_residual_h2
from .robust import design_mixed, design_worst_case_h2

DESIGNS: dict[str, Callable[[DesignTask], DesignResult]] = {
    "open_loop": design_open_loop,
    "kalman_tuned": design_kalman_tuned,
    "mixed": design_mixed,
    "paper": design_published,
    "worst_case_h2": design_worst_case_h2,
    "residual_h2": design_residual_h2,
    "estimator": design_estimator,
}


def design(task: DesignTask) -> DesignResult:
    """Design one observer; a failure is a result too, with its reason."""
    try:
        return DESIGNS[task.method](task)
    except SynthesisError as error:
        return DesignResult(task.name, None, None, {"status": "failed", "reason": str(error)}, task.problem)
