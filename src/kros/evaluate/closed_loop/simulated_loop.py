"""Loops in simulation: nonlinear models of all units, the observer as deployed, a controller that may saturate."""

import numpy as np

from ...core import Names
from ...data import EpisodeBatch
from ...identify import ModelSet
from ...observer import screened
from ...observer.data import ObserverData
from ...observer.simulate import Course
from .controller import Controller


def diverging(
    observer: ObserverData, models: ModelSet, batch: EpisodeBatch, controller: Controller, largest: float
) -> Names:
    """Return units whose loop diverges from where an episode began, its inputs being the command."""
    lifting, rows = models.lifting, [models.index(unit) for unit in batch.units]
    values = {name: v[rows] for name, v in models.parameters.items()}
    model = np.concatenate([models.A, models.B], axis=2)[rows, : lifting.n_states]
    n, q, x, u = lifting.n_states, list(observer.measured), batch.states[0], batch.inputs[0]
    K, (low, high) = controller.between(observer, models), controller.ends(observer, models.recorded_inputs)
    course, xi = Course(observer, len(rows), observer.own(values)), np.zeros((len(rows), K.n_states))
    course.begin(screened(observer, x[None][..., q], u[None]))
    past, diverged = lifting.window.hold(x, u), np.zeros(len(rows), dtype=bool)
    for command in batch.inputs:
        estimate = course.steps.x[:, :n].copy()
        observer.runtime.clip_estimate(estimate)
        u = np.clip(command + xi @ K.C.T + estimate @ K.D.T, low, high)
        xi = xi @ K.A.T + estimate @ K.B.T
        course.take(x[None][..., q], u[None])
        window = np.hstack([x, past])
        lifted = np.hstack([lifting.lift(window, values), lifting.lift_inputs(u, window, values)])
        x = np.einsum("bij,bj->bi", model, lifted)
        past = lifting.window.advance(window, u)
        diverged |= ~(np.abs(x) <= largest * models.output_scale[:n]).all(axis=-1)
        x[diverged], xi[diverged] = 0.0, 0.0
    return tuple(unit for unit, out in zip(batch.units, diverged, strict=True) if out)
