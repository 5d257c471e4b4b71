"""What drove the error of an observer along recorded episodes, and the error."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from ...data import EpisodeBatch
from ..data import ObserverData
from ..residual.one_step import one_step_residual
from ..screen import screened
from ..simulate import run_observer

Array = npt.NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Course:
    """What drove the error of an observer along recorded episodes, and the error."""

    omega: Array  # (n_samples - 1, batch, n): one-step residual; zero in internal states
    noise: Array  # (n_samples - 1, batch, q): what the sensor shows beside the recording, as it arrives
    first: Array  # (batch, n_window): first error, with the earlier ones that the lifting reads, which equal it
    error: Array  # (n_samples, batch, n)
    lengths: npt.NDArray[np.int64]  # (batch,)
    inputs: Array  # (n_samples, batch, m)
    y: Array  # (n_samples, batch, q): measurements as they arrive
    beyond: Array  # (n_samples, batch, n_recorded): what recorded states are beyond declared limits, by noise

    def mean_square(self, signal: Array) -> Array:
        """Return the mean square of every channel over every episode, shape (batch, k)."""
        inside = (np.arange(len(signal))[:, None] < self.lengths)[..., None]
        return np.asarray(np.sum(np.where(inside, signal, 0.0) ** 2, axis=0) / self.lengths[:, None])

    def taken(self, observer: ObserverData) -> npt.NDArray[np.bool_]:
        """Whether the observer takes all samples, shape (batch,)."""
        samples = screened(observer, self.y, self.inputs)
        good = np.isfinite(samples.y).all(axis=-1) & (samples.u == self.inputs).all(axis=-1)
        return np.asarray((good | (np.arange(len(good))[:, None] >= self.lengths)).all(axis=0))


def course(observer: ObserverData, batch: EpisodeBatch, estimates: Array | None = None) -> Course:
    """Return what drove an observer along episodes; recorded states stand for the true ones."""
    inputs, at, late = batch.inputs, list(observer.measured), observer.runtime.delay
    states = observer.runtime.clip_estimate(batch.states)
    values = {**observer.parameters, **observer.own(batch.parameters)} if observer.lifting.parameters else None
    due = states[np.maximum(np.arange(len(states)) - late, 0)][..., at]
    y = (
        batch.states[np.maximum(np.arange(len(states)) - late, 0)][..., at]
        if batch.shown is None
        else batch.measurements(at, arrived=False)
    )
    if estimates is None:
        estimates = run_observer(observer, y, inputs, values)
    # Measurements beyond the limits of their states are taken at the limit: what is left of their noise is smaller.
    taken = screened(observer, y, inputs).y
    noise = np.where(np.isfinite(taken), taken, y)[:-1] - due[:-1]
    noise[:late] = 0.0
    omega = held_residual(observer, states, inputs, values)
    start = observer.initial(taken[0], values)
    return Course(
        omega,
        noise,
        first_error(observer, states[0] - start),
        states - estimates,
        batch.lengths,
        inputs,
        y,
        batch.states - states,
    )


def held_residual(
    observer: ObserverData, states: Array, inputs: Array, parameters: Mapping[str, npt.ArrayLike] | None
) -> Array:
    """Return the one-step residual, shape (n_samples - 1, batch, n); values before the first sample equal it."""
    h = observer.lifting.history
    if h:
        states, inputs = (np.concatenate([np.repeat(v[:1], h, axis=0), v]) for v in (states, inputs))
    residual = one_step_residual(observer.lifting, observer.A, observer.B, states, inputs, parameters)
    residual[..., len(observer.recorded) :] = 0.0
    return residual


def first_error(observer: ObserverData, error: Array) -> Array:
    """Return the first error with equal earlier ones behind it, shape (batch, n_window)."""
    states = observer.lifting.states
    earlier = [states.index(name) for name, delay in observer.lifting.window.quantities if delay and name in states]
    return np.concatenate([error, error[:, earlier]], axis=1)
