"""The observer with states of its own: a predictor identified from training episodes by a subspace method, tuned where that is better."""

from __future__ import annotations

import time
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np

from ...core.errors import KrosError, SynthesisError
from ...lifting import Lifting
from ...observer import Observer, driven_coordinates, identify_predictor
from ...synthesis import Status, Synthesis
from ..certificates import DIVERGED
from ..task import DesignResult, DesignTask
from ..validation import ValidationSet, hidden_mean
from .tuned import tuned_where_better

UNCOVERED = "the observer has states of its own, identified from recordings; the uncertain set surrounds the nominal model"
_CIRCLE = {"sin": "cos", "cos": "sin"}


def design_predictor(task: DesignTask) -> DesignResult:
    """An observer whose hidden states are identified from the past of what it sees, with internal states that hold it.

    Raises
    ------
    SynthesisError
        Where the lifting reads what is not measured or past, everything is measured, recordings are too short, or the observer diverges.
    """
    began, data = time.perf_counter(), task.training.read()
    recipe = partial(identified, task, on_the_circle(task.models.lifting))
    try:
        kept, facts = tuned_where_better(
            task, data, recipe(data.on_time, iterations=0), lambda seen, _: recipe(seen.on_time), partial(in_coordinates, task)
        )
    except (KrosError, np.linalg.LinAlgError) as error:
        raise SynthesisError(str(error)) from error
    percent = float(hidden_mean(data.percent(kept), kept.measured))
    if not percent < DIVERGED:
        raise SynthesisError(
            f"Subspace-identified predictor: it diverges on training episodes (error {percent:.3g} % of the largest value); "
            "lifted functions that say nearly the same as the measurement do that, take them out of the lifting."
        )
    synthesis = Synthesis("memory", kept.controller, Status.CERTIFIED, kept.injection, solve_s=time.perf_counter() - began)
    facts = {"memory_states": task.predictor.states, **facts}
    nominal = {name: float(values[task.models.index(task.unit)]) for name, values in task.models.parameters.items()}
    observer = replace(kept, parameters=nominal, seen=task.training.seen)
    return DesignResult(task.name, observer, synthesis, facts, task.problem, UNCOVERED)


def identified(task: DesignTask, lifting: Lifting, data: ValidationSet, **options: Any) -> Observer:
    """Return the observer that episodes give; `options` as in `identify_predictor`."""
    models = task.models
    observer = identify_predictor(
        task.name,
        lifting,
        models.measured,
        models.recorded_inputs,
        data.batch,
        task.predictor.states,
        [task.predictor.importance.get(name, 1.0) for i, name in enumerate(models.lifting.states) if i not in models.measured],
        **({"episodes": task.predictor.episodes, "iterations": task.predictor.steps} | options),
    )
    return replace(observer, runtime=task.runtime, sensor=task.sensor)


def on_the_circle(lifting: Lifting) -> Lifting:
    """Return the lifting with a cosine beside every sine of a calibrated angle, and a sine beside every cosine: a predictor sees the angle itself."""
    functions = list(lifting.functions)
    for formula in lifting.formulas:
        outer = type(formula.written).__name__
        if outer in _CIRCLE and formula.text.strip().startswith(f"{outer}(") and formula.used & set(lifting.parameters):
            functions.append(_CIRCLE[outer] + formula.text.strip()[len(outer) :])
    return replace(lifting, functions=tuple(dict.fromkeys(functions)))


def in_coordinates(task: DesignTask, data: ValidationSet, observer: Observer) -> Observer:
    """Return the observer in coordinates in which recordings drive its internal states."""
    return driven_coordinates(observer, data.batch, task.models.output_scale[: len(observer.recorded)])
