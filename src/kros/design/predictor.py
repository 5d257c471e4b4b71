"""Maker of the observer with a memory: identified from training episodes, tuned on most of them, and kept as it was where tuning does no good."""

from __future__ import annotations

import time
from dataclasses import replace
from functools import partial
from typing import TYPE_CHECKING, Any

import numpy as np

from ..core.errors import KrosError, SynthesisError
from ..lifting import Lifting
from ..observer import Observer, driven_coordinates, observer_with_memory
from ..synthesis import Status
from .certificates import LOST
from .residual_shaped import OwnModel
from .tuned import tuned_where_better
from .validation import Judge, hidden_mean

if TYPE_CHECKING:
    from .task import Made, Task

_CIRCLE = {"sin": "cos", "cos": "sin"}
_REASON = "the observer has states of its own, identified from recordings; the uncertain set surrounds the nominal model"


def make_memory(task: Task) -> Made:
    """An observer whose hidden states are identified from the past of what it sees, with states that remember it.

    Raises
    ------
    SynthesisError
        Where the lifting reads what is not measured or past, everything is measured, recordings are too short, or the observer loses the machine.
    """
    began, judge = time.perf_counter(), task.tuning.read()
    recipe = partial(identified, task, on_the_circle(task.models.lifting))
    try:
        kept, facts = tuned_where_better(
            task, judge, recipe(judge, iterations=0), lambda seen, _: recipe(seen), partial(in_coordinates, task)
        )
    except (KrosError, np.linalg.LinAlgError) as error:
        raise SynthesisError(str(error)) from error
    percent = float(hidden_mean(judge.percent(kept), kept.measured))
    if not percent < LOST:
        raise SynthesisError(
            f"Observer with a memory: it loses the machine on training episodes (error {percent:.3g} % of the largest value); "
            "lifted functions that say nearly the same as the measurement do that, take them out of the lifting."
        )
    solve_s = time.perf_counter() - began
    model: dict[str, Any] = {
        "A": kept.A,
        "B": kept.B,
        "lifting": kept.lifting,
        "reason": _REASON,
        "replaces": kept.replaces,
        "internal": kept.internal,
    }
    made = OwnModel("memory", kept.controller, Status.CERTIFIED, kept.injection, solve_s=solve_s, **model)
    return made, {"memory_states": task.memory.states, **facts}, task.problem


def identified(task: Task, lifting: Lifting, judge: Judge, **options: Any) -> Observer:
    """Return the observer that episodes give; `options` as in `observer_with_memory`."""
    models, batch = task.models, judge.batch
    return observer_with_memory(
        task.name,
        lifting,
        models.measured,
        models.recorded_inputs,
        batch.states,
        batch.inputs,
        batch.lengths,
        [key.unit for key in batch.keys],
        models.sample_period_s,
        judge.parameters if lifting.parameters else None,
        task.memory.states,
        [task.memory.importance.get(name, 1.0) for i, name in enumerate(models.lifting.states) if i not in models.measured],
        **({"episodes": task.memory.episodes, "iterations": task.memory.steps} | options),
    )


def on_the_circle(lifting: Lifting) -> Lifting:
    """Return the lifting with a cosine beside every sine of a calibrated angle, and a sine beside every cosine: what remembers sees the angle itself."""
    functions = list(lifting.functions)
    for formula in lifting.formulas:
        outer = type(formula.written).__name__
        if outer in _CIRCLE and formula.text.strip().startswith(f"{outer}(") and formula.used & set(lifting.parameters):
            functions.append(_CIRCLE[outer] + formula.text.strip()[len(outer) :])
    return replace(lifting, functions=tuple(dict.fromkeys(functions)))


def in_coordinates(task: Task, judge: Judge, observer: Observer) -> Observer:
    """Return the observer in coordinates in which recordings drive its memory."""
    values = judge.parameters if observer.lifting.parameters else None
    sizes = task.models.output_scale[: len(observer.recorded)]
    return driven_coordinates(observer, judge.batch.states, judge.batch.inputs, sizes, values)
