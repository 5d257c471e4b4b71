"""Worst-case synthesis for the set asked for, or for the one whose observer is most accurate on episodes that were held out."""

from __future__ import annotations

import logging
from collections.abc import Callable
from dataclasses import replace

import numpy as np

from ...core.errors import SynthesisError
from ...identify.kinds import kind_of
from ..task import DesignResult, DesignTask
from ..validation import hidden_mean
from .coprime_models import design_for_models
from .disturbance_model import TUNED, DisturbanceModel
from .robust import design_worst_case_h2, design_worst_case_hinf
from .signals import design_for_signals, design_for_signals_in_hinf
from .tuned import held_out

log = logging.getLogger(__name__)
DESIGNS: dict[str, dict[str, Callable[[DesignTask], DesignResult]]] = {
    "worst_case_h2": {"signals": design_for_signals, "form": design_worst_case_h2},
    "worst_case_hinf": {"signals": design_for_signals_in_hinf, "form": design_worst_case_hinf},
}


def design_worst_case(task: DesignTask) -> DesignResult:
    """Return the worst-case observer of one set: sets are never mixed, and observers of several are compared on recordings.

    Without a set asked for, models that were refined are given an observer for signals and one for the form of the uncertain model. Others are given the
    one for the form alone, as is where something is asked for that only it has: a spectrum of the inputs, or correction through them.
    """
    wanted, ways = task.settings.set, DESIGNS[task.method]
    if wanted == "models":
        return design_for_models(task)
    if wanted != "auto":
        return ways[wanted](task)
    settings = task.settings
    if not kind_of(task.models.name).refined or settings.injection == "input" or settings.input_weight != TUNED:
        return ways["form"](task)
    made: list[DesignResult] = []
    reasons = []
    for name, design in ways.items():
        try:
            made.append(design(task))
        except SynthesisError as error:
            log.info("%s, set of %s: %s", task.name, name, error)
            reasons.append(str(error))
    if not made:
        raise SynthesisError("; ".join(reasons))
    data = task.training.read()
    held = held_out(data.batch.keys)
    judged = data.part([i for i, unseen in enumerate(held) if unseen])
    errors = np.array([judged.percent(found.observer) for found in made if found.observer is not None])
    best, form = made[int(np.argmin(hidden_mean(errors, task.models.measured)))], made[-1]
    assumed = DisturbanceModel.recorded(form.facts)  # all observers are certified on the form's set with its model, whichever is taken
    return replace(best, problem=form.problem, facts={"set": "form"} | (assumed.facts() if assumed else {}) | best.facts)
