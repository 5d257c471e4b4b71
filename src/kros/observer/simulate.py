"""Batched simulation of observers over many episodes at once."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt

from ..core.errors import DimensionError
from .careful import run_carefully
from .runtime import Estimate
from .screen import Screen, Screened, require_samples, started_anew

if TYPE_CHECKING:
    from .observer import Observer

Array = npt.NDArray[np.float64]


def run_observer(
    observer: Observer,
    y: Array,
    u: Array,
    parameters: Mapping[str, npt.ArrayLike] | None = None,
    estimate: Estimate | str = Estimate.PREDICT,
) -> Array:
    """Run an observer over a batch of episodes, one Python step per sample for the whole batch.

    Parameters
    ----------
    observer : Observer
    y : ndarray, shape (n_samples, batch, q)
        Row k is what arrives at k; NaN or infinite where a measurement is missing, which then corrects nothing.
    u : ndarray, shape (n_samples, batch, m)
        Not finite where an input is not known: the last good value stands for it. What is implausible, and where a run starts: see `screen`.
    parameters : mapping of str to array_like, shape (batch,)
        Lifting parameters of the machine behind each episode; the observer's own where absent.
    estimate : Estimate or "predict" or "filter"
        Row k of a prediction is the estimate of the state at k from what arrived up to k - 1; of a filtered estimate, up to k.

    Returns
    -------
    ndarray, shape (n_samples, batch, n)
        Row 0 of a prediction is the start.

    Raises
    ------
    DimensionError
        When measurements and inputs do not fit to each other or to the observer.
    ConfigError
        When a parameter is unknown, missing or not finite.
    """
    wanted = Estimate(estimate)
    if wanted is Estimate.PREDICT:
        return run_observers([observer], y, u, parameters)[0]
    samples, values = judged(observer, y, u), observer.values(parameters, np.shape(y)[1:2])
    return started_anew(lambda y, u, values: (run_carefully(observer, y, u, values, wanted),), samples, values)[0]


def run_observers(observers: Sequence[Observer], y: Array, u: Array, parameters: Mapping[str, npt.ArrayLike] | None = None) -> Array:
    """Run observers of one and the same model, which differ in their corrections, side by side.

    Parameters
    ----------
    observers : sequence of Observer
        Of the same lifting, measured states and inputs; corrections may have different orders.
    y, u, parameters
        As in `run_observer`.

    Returns
    -------
    ndarray, shape (observer, n_samples, batch, n)
        A view with the samples outermost in memory.
    """
    observer = observers[0]
    samples, values = judged(observer, y, u), observer.values(parameters, np.shape(y)[1:2])
    lifting = observer.lifting
    if any((o.lifting, o.measured, o.inputs) != (lifting, observer.measured, observer.inputs) for o in observers[1:]):
        raise DimensionError(
            f"Running {len(observers)} observers side by side: they differ in lifting, measured states or inputs; run them one by one."
        )
    if any(o.runtime.delay or o.runtime.limited or _screens(o) != _screens(observer) for o in observers):
        return np.stack([_alone(o, y, u, parameters) for o in observers])
    return started_anew(lambda y, u, values: (_together(observers, y, u, values),), samples, values)[0].transpose(2, 0, 1, 3)


def judged(observer: Observer, y: Array, u: Array) -> Screened:
    """Return a batch of samples as an observer takes them."""
    y, u = np.asarray(y, dtype=float), np.asarray(u, dtype=float)
    require_samples(f"observer {observer.name}", len(observer.measured), observer.inputs, y, u)
    return Screen.of(observer).take(y, u)


def _alone(observer: Observer, y: Array, u: Array, parameters: Mapping[str, npt.ArrayLike] | None) -> Array:
    if not (observer.runtime.delay or observer.runtime.limited):
        return run_observers([observer], y, u, parameters)[0]
    samples, values = judged(observer, y, u), observer.values(parameters, np.shape(y)[1:2])
    return started_anew(lambda y, u, values: (run_carefully(observer, y, u, values, Estimate.PREDICT),), samples, values)[0]


def _screens(observer: Observer) -> tuple[bytes, ...]:
    screen = Screen.of(observer)
    return tuple(
        side.tobytes() for bounds in (screen.measured, screen.inputs) for side in (bounds.lower, bounds.upper, bounds.least, bounds.most)
    )


def _together(observers: Sequence[Observer], y: Array, u: Array, values: Mapping[str, npt.ArrayLike]) -> Array:
    """Run observers of one model on screened samples; shape (n_samples, batch, observer, n)."""
    observer, n_samples, batch = observers[0], *y.shape[:2]
    lifting = observer.lifting
    n, n_lifted, m, k = lifting.n_states, lifting.n_lifted, observer.B.shape[1], len(observers)
    order = max(o.controller.n_states for o in observers)
    step = np.stack([_padded(o, order) for o in observers])
    # One column a machine, so that each quantity of all machines lies together: [theta, x^c, u, y]. The product gives [x_hat+, x^c+].
    column = np.zeros((k, step.shape[2], batch))
    row = np.swapaxes(column, 1, 2)
    lifted, inflow, measurement = row[..., :n_lifted], row[..., n_lifted + order : n_lifted + order + m], row[..., n_lifted + order + m :]
    for own, first in zip(row, observers, strict=True):
        own[..., :n] = first.initial(y[0], values)
    missing = ~np.isfinite(y)
    gone = np.atleast_1d(missing.any(axis=(1, 2)))
    estimates = np.empty((n_samples, k, n, batch))
    following = np.empty((k, n + order, batch))
    plain = not (lifting.history or lifting.input_functions)
    held = np.broadcast_to(u[0], (k, *u[0].shape))
    earlier = lifting.window.hold(row[..., :n], held)
    with np.errstate(over="ignore", invalid="ignore"):
        for sample in range(n_samples):
            estimates[sample] = column[:, :n]
            if plain:
                lifting.lift_into(lifted, values)
                inflow[...] = u[sample]
            else:
                held = np.broadcast_to(u[sample], held.shape)
                window = np.concatenate([row[..., :n], earlier], axis=-1)
                lifting.lift_into(lifted, values, earlier)
                inflow[...] = lifting.lift_inputs(held, window, values)
                earlier = lifting.window.advance(window, held)
            measurement[...] = y[sample]
            if gone[sample]:  # what is predicted stands for what is missing, so that it corrects nothing
                np.copyto(measurement, row[..., list(observer.measured)], where=missing[sample])
            np.matmul(step, column, out=following)
            column[:, :n] = following[:, :n]
            column[:, n_lifted : n_lifted + order] = following[:, n:]
    return estimates.transpose(0, 3, 1, 2)


def _padded(observer: Observer, order: int) -> Array:
    """The one-step map with silent controller states up to an order."""
    n, nl, own = observer.lifting.n_states, observer.lifting.n_lifted, observer.controller.n_states
    missing = order - own
    step = np.insert(observer.one_step, [nl + own] * missing, 0.0, axis=1)
    return np.ascontiguousarray(np.insert(step, [n + own] * missing, 0.0, axis=0))
