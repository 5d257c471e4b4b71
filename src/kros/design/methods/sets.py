"""Worst-case synthesis for the set whose observer is most accurate on episodes that were held out."""

from __future__ import annotations

import logging
from dataclasses import replace

import numpy as np

from ...core.errors import SynthesisError
from ...identify.kinds import kind_of
from ..task import DesignResult, DesignTask
from ..validation import hidden_mean
from .disturbance_model import TUNED, DisturbanceModel
from .robust import design_worst_case_h2
from .signals import design_for_signals
from .tuned import held_out

log = logging.getLogger(__name__)


def design_worst_case(task: DesignTask) -> DesignResult:
    """Return the observer for signals or for the form, as recordings decide; of models that were not refined, or where an input weight is given, the form's."""
    settings = task.settings
    if not kind_of(task.models.name).refined or settings.input_weight != TUNED:
        return design_worst_case_h2(task)
    made: list[DesignResult] = []
    reasons = []
    for name, design in (("signals", design_for_signals), ("form", design_worst_case_h2)):
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
    assumed = DisturbanceModel.recorded(
        form.facts
    )  # all observers are certified on the form's set with its model, whichever is taken
    return replace(
        best, problem=form.problem, facts={"set": "form"} | (assumed.facts() if assumed else {}) | best.facts
    )
