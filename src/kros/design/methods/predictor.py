"""The observer with states of its own: a predictor identified from training episodes by a subspace method, tuned where that is better."""

from __future__ import annotations

import logging
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import numpy as np
import numpy.typing as npt

from ...core.errors import KrosError, SynthesisError
from ...data import EpisodeBatch
from ...evaluate import error_rms
from ...lifting import Lifting
from ...observer import Observer, PastMoments, Runtime, run_observer
from ...observer.certificate.error import error_system
from ...observer.certificate.search import quick_gain
from ...observer.limits import sides
from ...observer.predictor.build import embedded_with
from ...observer.predictor.choice import AT_LIMITS, Recipe, at_limits, choose, filled_in
from ...observer.predictor.driven import driven_coordinates
from ...observer.predictor.limited import conditioned, with_limits
from ...observer.predictor.moments import limited
from ...observer.predictor.start import with_start
from ...observer.predictor.tuning import tune_predictor
from ...synthesis import Status, Synthesis
from ...synthesis.residual_shaped.shaping_filter import Basis
from ..certificates import DIVERGED, dropout_error_percent, scales_of
from ..estimators import make_learned
from ..task import DesignResult, DesignTask
from ..validation import TrainingSet, ValidationSet, hidden_mean
from .tuned import held_out, tuned_where_better

_PARTS = ((25.0,), (60.0, 12.0), (60.0, 12.0, 2.4))  # of an episode: sets of time constants of slow lags
_TUNED = 6000  # samples
_RIDGES = (1e-6, 1e-5, 1e-7, 1e-8)  # of what predicts measurements that are missing
UNCOVERED = (
    "the observer has states of its own, identified from recordings; the uncertain set surrounds the nominal model"
)
log = logging.getLogger(__name__)
_SAMPLES, _EPISODES = 6000, 12  # that an observer is conditioned on, at most
_SHARES = (1.0, 0.75, 0.5, 0.25, 0.1)  # of the gain that is best, until a certificate covers it
_CLOSE, _SHARE = 0.01, 0.001  # share of a limit that counts as at it, and how much of an episode has to be
_TINY = np.finfo(float).tiny
_AS_GOOD = 1.01  # ratio of errors that is no reason to prefer one to another
_BEYOND = 1.5  # times the learned estimator's error, beyond which another predictor is looked for
Settle = Callable[[ValidationSet, Observer], Observer]
_CIRCLE = {"sin": "cos", "cos": "sin"}


@dataclass(frozen=True)
class Effort:
    """How much a predictor may cost."""

    samples: int  # of recordings, in so many units and conditions at most
    groups: int  # of recordings, in so many units and conditions at most
    delays: tuple[int, ...]  # candidates
    internal: tuple[int, ...]  # candidates
    steps: int  # of tuning


EFFORTS = {
    "full": Effort(1_000_000, 100, (40, 80), (12, 18, 24, 32), 15),
    "quick": Effort(200_000, 24, (40,), (24,), 4),
}


def design_predictor(task: DesignTask) -> DesignResult:
    """An observer whose hidden states are identified from the past of what it sees, with internal states that hold it."""
    began, effort = time.perf_counter(), EFFORTS[task.predictor.effort]
    try:
        data, settle = recordings(task, effort).read_whole(), partial(settled, task, reaching(task))
        batch, steps = data.on_time.batch, effort.steps if task.predictor.steps is None else task.predictor.steps
        plan = Plan.of(task, effort, batch)
        kept, facts = plan.made(task, data, settle, steps)
        if (before_limits(task, batch) < batch.lengths).any():
            errors = errors_beside_learned(task, data.part(np.flatnonzero(held_out(batch.keys)).tolist()))
            # Where a measurement follows an input there is a controller, which winds up: recordings until the limit are the better guide, mostly.
            if not plan.past.static.any() or errors(kept)[1] > _BEYOND:
                other = Plan.of(task, effort, batch, whole=True)
                forgets = other.made(task, data, settle, steps)
                (ours, most), (theirs, limit) = errors(forgets[0]), errors(kept)
                if np.all(ours <= _AS_GOOD * theirs) or most < limit > _BEYOND:
                    plan, (kept, facts) = other, forgets
    except (KrosError, np.linalg.LinAlgError) as error:
        raise SynthesisError(str(error)) from error
    percent = float(hidden_mean(task.training.read().percent(kept), kept.measured))
    if not percent < DIVERGED:
        raise SynthesisError(
            f"Subspace-identified predictor: it diverges on training episodes (error {percent:.3g} % of the largest value); "
            "lifted functions that say nearly the same as the measurement do that, take them out of the lifting."
        )
    synthesis = Synthesis(
        "memory", kept.controller, Status.CERTIFIED, kept.injection, solve_s=time.perf_counter() - began
    )
    nominal = {name: float(values[task.models.index(task.unit)]) for name, values in task.models.parameters.items()}
    observer = replace(kept, parameters=nominal, seen=task.training.seen)
    return DesignResult(task.name, observer, synthesis, {**plan.facts(task), **facts}, task.problem, UNCOVERED)


def errors_beside_learned(
    task: DesignTask, unseen: ValidationSet
) -> Callable[[Observer], tuple[npt.NDArray[np.float64], float]]:
    """Return what gives an observer's errors of hidden states by condition, in percent, and how many times those of the learned estimator they are at most."""
    conditions = [key.condition for key in unseen.batch.keys]
    parts = [
        unseen.part([i for i, c in enumerate(conditions) if c == condition]) for condition in dict.fromkeys(conditions)
    ]
    learned = make_learned(task.recordings or task.training, task.models.lifting, task.models.measured)
    hidden = list(learned.estimated)
    rival = np.array([part.compare([learned.run(part.batch, part.parameters)])[0][hidden] for part in parts])

    def errors(observer: Observer) -> tuple[npt.NDArray[np.float64], float]:
        own = np.array([part.percent(observer)[hidden] for part in parts])
        return own, float((own / rival).max())

    return errors


def recordings(task: DesignTask, effort: Effort) -> TrainingSet:
    """Return the training episodes that a predictor is made from."""
    whole = task.recordings or task.training
    if not task.predictor.others:
        whole = replace(
            whole, keys=tuple(key for key in whole.keys if key.condition == task.training.keys[0].condition)
        )
    return whole.within(effort.samples, effort.groups)


@dataclass(frozen=True, eq=False)
class Plan:
    """What a predictor is made by."""

    past: PastMoments
    recipe: Recipe
    importance: list[float]
    emphasis: dict[str, tuple[float, ...]]
    fill: Callable[[EpisodeBatch], EpisodeBatch] | None = None

    @classmethod
    def of(cls, task: DesignTask, effort: Effort, batch: EpisodeBatch, *, whole: bool = False) -> Plan:
        """Choose it, from recordings until machines come to a limit or from whole ones."""
        models, asked, shortest = task.models, task.predictor, int(batch.lengths.min())
        first = task.training.keys[0].condition
        others = sorted({key.condition for key in batch.keys} - {first})
        delays = tuple(d for d in effort.delays if 8 * d <= shortest) or (max(2, min(effort.delays[0], shortest // 8)),)
        lags = tuple(tuple(1 - part / max(shortest, 2 * part) for part in parts) for parts in _PARTS)
        every = Basis(delays[-1], tuple(dict.fromkeys(pole for poles in lags for pole in poles)))
        importance, until, fill = importance_of(task), None if whole else before_limits(task, batch), None
        past = PastMoments.of(on_the_circle(models.lifting), models.measured, batch, every, until)
        moved = {key.unit for key in batch.keys if key.condition == first}
        judged = {unit for unit, condition in zip(past.units, past.conditions, strict=True) if condition == first}
        if not whole and len(judged) < min(
            2, len(moved)
        ):  # the others start at a limit, and none is left to judge by another one
            return cls.of(task, effort, batch, whole=True)
        if whole:
            past, fill = filled_in(past, batch, *sides(task.limits, models.lifting.states[: batch.states.shape[-1]]))
            batch = fill(batch)
        internal = effort.internal if asked.states is None else (asked.states,)
        counts = {first: 1.0, **dict.fromkeys(others, asked.others)}
        free = np.array(
            [name not in task.limits for i, name in enumerate(models.lifting.states) if i not in models.measured]
        )
        beyond = {limited(c): AT_LIMITS * count * free for c, count in counts.items() if limited(c) in past.conditions}
        rows = firsts(batch)
        recipe = choose(
            past,
            batch.take(rows),
            {**counts, **beyond},
            importance,
            delays,
            lags,
            internal,
            None if until is None else until[rows],
        )
        tuned = {c: tuple(count if share > 0 else 0.0 for share in recipe.weights[c]) for c, count in counts.items()}
        return cls(past.restricted(recipe.basis), recipe, importance, tuned, fill)

    def made(
        self, task: DesignTask, data: ValidationSet, settle: Settle, steps: int
    ) -> tuple[Observer, dict[str, Any]]:
        """Return the observer as it is deployed, tuned where that is better, with what the records say of that."""
        start = self.observer(task, data)
        if steps:
            return tuned_where_better(
                task, data, start, lambda seen, _: self.observer(task, seen, steps), settle, self.score
            )
        return settle(data.part(firsts(data.batch)), start), {}

    def observer(self, task: DesignTask, data: ValidationSet, steps: int = 0) -> Observer:
        """Return the observer, tuned by some steps on recordings, that of the moments without any."""
        batch, model, asked, models = (
            data.on_time.batch,
            self.recipe.model(self.past, self.importance),
            task.predictor,
            task.models,
        )
        few = some(batch if self.fill is None else self.fill(batch), asked.episodes if steps else 1)
        if steps:
            slowest, recipe = max(self.recipe.basis.poles), self.recipe
            model, _ = tune_predictor(
                model, self.past, few, self.importance, recipe.deviation, slowest, steps, weights=self.emphasis
            )
        # Rows of measured states count where measurements are missing. Fitted to all conditions they are those of none, and drift.
        home = few.take([i for i, key in enumerate(few.keys) if key.condition == task.training.keys[0].condition])
        made = embedded_with(task.name, self.past, model, models.recorded_inputs, home, _RIDGES)
        made = [replace(one, runtime=Runtime(task.runtime.delay), sensor=task.sensor) for one in made]
        if task.limits:
            made = [with_limits(one, *sides(task.limits, one.recorded)) for one in made]
        without = dropout_error_percent(made, task.training.first_of_units().read())
        return self._started(
            task, replace(data, batch=some(data.batch, asked.episodes)), few, made[int(np.argmin(without))]
        )

    def _started(self, task: DesignTask, data: ValidationSet, few: EpisodeBatch, observer: Observer) -> Observer:
        """Return the observer with a start in motion, unless recordings start better without."""
        first = [i for i, key in enumerate(few.keys) if key.condition == task.training.keys[0].condition]
        parts = [few] if len(first) == len(few.keys) else [few, few.take(first)]
        tried = [*(with_start(observer, part, self.past.static, self.past.free) for part in parts), observer]
        errors = self.score(data, tried)
        return (
            tried[int(np.flatnonzero(errors <= _AS_GOOD * errors.min())[0])] if np.isfinite(errors).any() else observer
        )

    def score(self, data: ValidationSet, observers: Sequence[Observer]) -> npt.NDArray[np.float64]:
        """Return errors of observers in percent of the range as the recipe counts them: geometric means over hidden states, units and conditions."""
        keys, measured, found = data.batch.keys, observers[0].measured, []
        hidden = [i for i in range(data.batch.states.shape[-1]) if i not in measured]
        nothing, conditions = (0.0,) * len(hidden), [key.condition for key in keys]
        weights = np.array(
            [np.multiply(self.emphasis.get(c, nothing), self.importance) / conditions.count(c) for c in conditions]
        )
        for observer in observers:
            values = data.parameters if observer.lifting.parameters else None
            estimate = run_observer(observer, data.measurements(measured), data.batch.inputs, values)
            rms = error_rms(estimate[..., hidden], data.batch.states[..., hidden], data.batch.lengths)
            with np.errstate(
                invalid="ignore"
            ):  # not a number where it diverges in what does not count: refused as well
                found.append(
                    np.sum(weights * np.log(np.maximum(np.where(np.isfinite(rms), rms, np.inf), _TINY))) / weights.sum()
                )
        return 100 * np.exp(found)

    def facts(self, task: DesignTask) -> dict[str, Any]:
        """Return what the records say."""
        recipe, dt = self.recipe, task.models.sample_period_s
        hidden = [name for i, name in enumerate(task.models.lifting.states) if i not in task.models.measured]
        return {
            "memory_states": recipe.internal,
            "memory": {
                "effort": task.predictor.effort,
                "delays": recipe.basis.delays,
                "lags_s": [dt / (1 - pole) for pole in recipe.basis.poles],
                "deviation": recipe.deviation,
                "conditions": {
                    condition: dict(zip(hidden, shares, strict=True)) for condition, shares in recipe.weights.items()
                },
                "left_out_percent": {name: 100 * error for name, error in zip(hidden, recipe.held_out, strict=True)},
            },
        }


def firsts(batch: EpisodeBatch, count: int = 1) -> list[int]:
    """Return where the first episodes of every unit and condition are."""
    groups = [(key.unit, key.condition) for key in batch.keys]
    return [i for i, group in enumerate(groups) if groups[:i].count(group) < count]


def some(batch: EpisodeBatch, count: int) -> EpisodeBatch:
    """Return the first so many episodes of every unit and condition, cut to a length; of short ones, as many samples from all over the recordings."""
    length = min(_TUNED, int(batch.lengths.min()))
    if length == _TUNED:
        return batch.take(firsts(batch, count)).head(length)
    groups: dict[tuple[str, str], list[int]] = {}
    for i, key in enumerate(batch.keys):
        groups.setdefault((key.unit, key.condition), []).append(i)
    wanted = -(-count * _TUNED // length)
    rows = [
        own[j]
        for own in groups.values()
        for j in np.unique(np.linspace(0, len(own) - 1, min(wanted, len(own))).round().astype(int))
    ]
    return batch.take(sorted(rows)).head(length)


def before_limits(task: DesignTask, batch: EpisodeBatch) -> npt.NDArray[np.int64]:
    """Return how many samples of every episode there are before a state comes to a limit, shape (batch,)."""
    lower, upper = sides(task.limits, task.models.lifting.states[: batch.states.shape[-1]])
    met = np.any(at_limits(batch.states, lower, upper), axis=(0, -1))
    return np.where(met.any(axis=0), np.minimum(met.argmax(axis=0), batch.lengths), batch.lengths)


def importance_of(task: DesignTask) -> list[float]:
    """Return the weights of the hidden states' logarithmic errors."""
    return [
        task.predictor.importance.get(name, 1.0)
        for i, name in enumerate(task.models.lifting.states)
        if i not in task.models.measured
    ]


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
        system = error_system(found, scales_of([found], data, task)[0])
        if np.isfinite([quick_gain(system), quick_gain(system.mismatch())]).all():
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
