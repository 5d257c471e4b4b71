"""Maker of the observer with a memory: identified from training episodes, tuned on most of them, and kept as it was where tuning does no good."""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np

from ..core.errors import KrosError, SynthesisError
from ..data.population import EpisodeKey
from ..lifting import Lifting
from ..observer import Observer, Past, driven_coordinates, refit_measured_rows, relift_certificate, remembering_observer, tune_observer
from ..synthesis import Status
from .relift import LOST, blind_percent, first_episodes, scales_of
from .residual_maker import OwnModel
from .tuning import Judge, hidden_mean

if TYPE_CHECKING:
    from .makers import Made, Task

_FIT_S, _TUNE_S, _STEPS = 6.0, 5.0, 8
_CIRCLE = {"sin": "cos", "cos": "sin"}
_REASON = "the observer has states of its own, identified from recordings; the uncertain set surrounds the nominal model"


def make_memory(task: Task) -> Made:
    """An observer whose hidden states are identified from the past of what it sees, with states that remember it.

    Tuning is kept where the observer stays certified as it runs, bears missing measurements as before, and does better on training episodes that were
    held out of tuning.

    Raises
    ------
    SynthesisError
        Where the lifting reads what is not measured or past, everything is measured, or recordings are too short.
    """
    began, judge = time.perf_counter(), task.tuning.read()
    try:
        start = fitted(task, judge)
        tuned, steps = improved(task, judge, start)
    except (KrosError, np.linalg.LinAlgError) as error:
        raise SynthesisError(str(error)) from error
    kept, facts = chosen(task, judge, start, tuned)
    spent = time.perf_counter() - began
    made = OwnModel(
        "memory",
        kept.controller,
        Status.OPTIMAL,
        kept.injection,
        solve_s=spent,
        A=kept.A,
        B=kept.B,
        lifting=kept.lifting,
        reason=_REASON,
    )
    return made, {"memory_states": task.memory_states, "tuning_steps": steps, **facts}, task.problem


def fitted(task: Task, judge: Judge) -> Observer:
    """Return the observer with a memory as regression and reduction give it."""
    models, batch = task.models, judge.batch
    lifting = on_the_circle(models.lifting)
    values = judge.parameters if lifting.parameters else None
    units = [key.unit for key in batch.keys]
    past = Past.of(lifting, models.measured, batch.states, batch.inputs, batch.lengths, units, values)
    short = judge.first(_FIT_S / models.sample_period_s).batch
    return remembering_observer(
        task.name, past, task.memory_states, models.recorded_inputs, short.states, short.inputs, models.sample_period_s, values
    )


def on_the_circle(lifting: Lifting) -> Lifting:
    """Return the lifting with a cosine beside every sine of a calibrated angle, and a sine beside every cosine: what remembers sees the angle itself."""
    functions = list(lifting.functions)
    for formula in lifting.formulas:
        outer = type(formula.expression).__name__
        if outer in _CIRCLE and formula.text.strip().startswith(f"{outer}(") and formula.used & set(lifting.parameters):
            functions.append(_CIRCLE[outer] + formula.text.strip()[len(outer) :])
    return replace(lifting, functions=tuple(dict.fromkeys(functions)))


def improved(task: Task, judge: Judge, start: Observer) -> tuple[Observer, int]:
    """Return the observer tuned on the training episodes that are not held out, and the number of steps."""
    held = held_out(judge.batch.keys)
    few = judge.first(_TUNE_S / task.models.sample_period_s).part([i for i in range(len(held)) if not held[i]])
    values = few.parameters if start.lifting.parameters else None
    tuned = tune_observer(start, few.batch.states, few.batch.inputs, values, iterations=_STEPS)
    return refit_measured_rows(tuned.observer, few.batch.states, few.batch.inputs, values), len(tuned.criterion) - 1


def held_out(keys: Sequence[EpisodeKey]) -> list[bool]:
    """Tell which episodes tuning does not see: the last one of every unit, or every third unit's where units have one each."""
    last = {key.unit: i for i, key in enumerate(keys)}
    if len(last) == len(keys):
        return [i % 3 == 2 for i in range(len(keys))]
    return [last[key.unit] == i for i, key in enumerate(keys)]


def chosen(task: Task, judge: Judge, start: Observer, tuned: Observer) -> tuple[Observer, dict[str, Any]]:
    """Return the tuned observer where nothing speaks against it, else the first one; in coordinates in which recordings drive the memory."""
    held = held_out(judge.batch.keys)
    unseen, seen = judge.part([i for i in range(len(held)) if held[i]]), first_episodes(task.tuning).read()
    before, after = (float(hidden_mean(unseen.percent(o), o.measured)) for o in (start, tuned))
    blind = blind_percent([start, tuned], seen, task.models.sample_period_s)
    settled = in_coordinates(task, seen, tuned)
    better = after <= before and bool(blind[1] < LOST or blind[0] >= LOST)
    kept = better and relift_certificate(settled, scales=scales_of([settled], seen, task)[0], mismatch=False).certified
    return settled if kept else in_coordinates(task, seen, start), {"tuned": kept, "held_out_percent": {"fitted": before, "tuned": after}}


def in_coordinates(task: Task, judge: Judge, observer: Observer) -> Observer:
    """Return the observer in coordinates in which recordings drive its memory."""
    values = judge.parameters if observer.lifting.parameters else None
    sizes = task.models.output_scale[: len(observer.recorded)]
    return driven_coordinates(observer, judge.batch.states, judge.batch.inputs, sizes, values)
