"""The observer with states of its own: a predictor identified from training episodes by a subspace method, tuned where that is better."""

from __future__ import annotations

import logging
import time
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np

from ...core.errors import KrosError, SynthesisError
from ...data import EpisodeBatch
from ...lifting import Lifting
from ...observer import Observer, Runtime, conditioned, driven_coordinates, identify_predictor, relift_certificate, with_limits
from ...observer.limits import sides
from ...synthesis import Status, Synthesis
from ..certificates import DIVERGED, scales_of
from ..task import DesignResult, DesignTask
from ..validation import ValidationSet, hidden_mean
from .tuned import tuned_where_better

UNCOVERED = "the observer has states of its own, identified from recordings; the uncertain set surrounds the nominal model"
log = logging.getLogger(__name__)
_SAMPLES, _EPISODES = 6000, 12  # that an observer is conditioned on, at most
_SHARES = (1.0, 0.5)  # of the gain that is best, until a certificate covers it
_CLOSE, _SHARE = 0.01, 0.001  # share of a limit that counts as at it, and how much of an episode has to be
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
            task, data, recipe(data.on_time, iterations=0), lambda seen, _: recipe(seen.on_time), partial(settled, task, reaching(task))
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
        importance_of(task),
        **({"episodes": task.predictor.episodes, "iterations": task.predictor.steps} | options),
    )
    observer = replace(observer, runtime=Runtime(task.runtime.delay), sensor=task.sensor)
    return with_limits(observer, *sides(task.limits, observer.recorded)) if task.limits else observer


def importance_of(task: DesignTask) -> list[float]:
    """Return the weights of the hidden states' logarithmic errors."""
    return [task.predictor.importance.get(name, 1.0) for i, name in enumerate(task.models.lifting.states) if i not in task.models.measured]


def on_the_circle(lifting: Lifting) -> Lifting:
    """Return the lifting with a cosine beside every sine of a calibrated angle, and a sine beside every cosine: a predictor sees the angle itself."""
    functions = list(lifting.functions)
    for formula in lifting.formulas:
        outer = type(formula.written).__name__
        if outer in _CIRCLE and formula.text.strip().startswith(f"{outer}(") and formula.used & set(lifting.parameters):
            functions.append(_CIRCLE[outer] + formula.text.strip()[len(outer) :])
    return replace(lifting, functions=tuple(dict.fromkeys(functions)))


def settled(task: DesignTask, reached: EpisodeBatch | None, data: ValidationSet, observer: Observer) -> Observer:
    """Return the observer conditioned on episodes that meet its limits, in coordinates in which recordings drive its internal states."""
    sizes = task.models.output_scale[: len(observer.recorded)]
    as_is = driven_coordinates(observer, data.batch, sizes)
    if reached is None:
        return as_is
    best = conditioned(observer, reached, importance_of(task))
    for share in _SHARES:
        found = driven_coordinates(replace(observer, A=share * best.A + (1 - share) * observer.A), data.batch, sizes)
        if relift_certificate(found, scales=scales_of([found], data, task)[0], mismatch=False).certified:
            return found
    log.info("%s is cut off at its limits and not conditioned: no certificate covers it otherwise.", task.name)
    return as_is


def reaching(task: DesignTask) -> EpisodeBatch | None:
    """Return the episodes that are longest at a limit of a hidden state, cut short; None where there are none."""
    names = task.models.lifting.states
    lower, upper = sides(task.limits, names)
    at = [i for i in range(len(names)) if i not in task.models.measured and np.isfinite([lower[i], upper[i]]).any()]
    if task.at_limits is None or not at:
        return None
    batch = task.at_limits.read().on_time.batch
    batch = batch.head(min(_SAMPLES, int(batch.lengths.min())))
    x = batch.states[..., at]
    ends = [np.clip(side[at], -np.finfo(float).max, np.finfo(float).max) for side in (lower, upper)]
    low, high = (end - sign * _CLOSE * np.abs(end) for sign, end in zip((-1, 1), ends, strict=True))
    met = np.mean((x <= low) | (x >= high), axis=(0, 2))
    rows = [int(i) for i in np.argsort(-met, kind="stable")[:_EPISODES] if met[i] > _SHARE]
    return batch.take(rows) if rows else None
