"""Loops in simulation: nonlinear models of all units, the observer as deployed, a controller that may saturate."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from controller import Controller

from kros.data import EpisodeBatch
from kros.identify import ModelSet
from kros.observer.data import ObserverData
from kros.observer.screen import screened
from kros.observer.simulate import Course


@dataclass(frozen=True)
class LoopSettings:
    """When a loop diverges, and how closely its margin is searched for."""

    largest: float = 100.0  # ranges: a state beyond has diverged
    tolerance: float = 0.01  # relative width of the searches for margin and gain


DEFAULT = LoopSettings()


def diverging(observer: ObserverData, models: ModelSet, batch: EpisodeBatch, controller: Controller) -> tuple[str, ...]:
    """Return units whose loop diverges from where an episode began, its inputs being the command."""
    lifting, rows = models.lifting, [models.index(unit) for unit in batch.units]
    values = {name: v[rows] for name, v in models.parameters.items()}
    model = np.concatenate([models.A, models.B], axis=2)[rows, : lifting.n_states]
    n, q, x, u = lifting.n_states, list(observer.measured), batch.states[0], batch.inputs[0]
    K, limits = controller.placed(observer, models), controller.limits
    low, high = np.array([limits.get(name, (-np.inf, np.inf)) for name in models.recorded_inputs]).T
    course, xi = Course(observer, len(rows), observer.own(values)), np.zeros((len(rows), K.n_states))
    course.begin(screened(observer, x[None][..., q], u[None]))
    past, diverged = lifting.window.hold(x, u), np.zeros(len(rows), dtype=bool)
    for command in batch.inputs:
        estimate = observer.runtime.clip_estimate(course.steps.x)[:, :n]
        u = np.clip(command + xi @ K.C.T + estimate @ K.D.T, low, high)
        xi = xi @ K.A.T + estimate @ K.B.T
        course.take(x[None][..., q], u[None])
        window = np.hstack([x, past])
        lifted = np.hstack([lifting.lift(window, values), lifting.lift_inputs(u, window, values)])
        x = np.einsum("bij,bj->bi", model, lifted)
        past = lifting.window.advance(window, u)
        diverged |= ~(np.abs(x) <= DEFAULT.largest * models.output_scale[:n]).all(axis=-1)
        x[diverged], xi[diverged] = 0.0, 0.0
        if diverged.all():
            break
    return tuple(unit for unit, out in zip(batch.units, diverged, strict=True) if out)
