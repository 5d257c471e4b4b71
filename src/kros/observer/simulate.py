"""Batched simulation of observers over many episodes at once."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt

from ..core.errors import DimensionError
from .careful import run_carefully
from .runtime import Estimate

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
    parameters : mapping of str to array_like, shape (batch,)
        Lifting parameters of the machine behind each episode; the observer's own where absent.
    estimate : Estimate or "predict" or "filter"
        Row k of a prediction is the estimate of the state at k from what arrived up to k - 1; of a filtered estimate, up to k.

    Returns
    -------
    ndarray, shape (n_samples, batch, n)
        Row 0 of a prediction is the start.
    """
    wanted = Estimate(estimate)
    if wanted is Estimate.PREDICT:
        return run_observers([observer], y, u, parameters)[0]
    require_recordings(f"observer {observer.name}", observer.inputs, y, u)
    return run_carefully(observer, y, u, parameters, wanted)


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
    require_recordings(f"observer {observer.name}", observer.inputs, y, u)
    lifting, n_samples, batch = observer.lifting, *y.shape[:2]
    if any((o.lifting, o.measured, o.inputs) != (lifting, observer.measured, observer.inputs) for o in observers[1:]):
        raise DimensionError(
            f"Running {len(observers)} observers side by side: they differ in lifting, measured states or inputs; run them one by one."
        )
    if any(o.runtime.delay or o.runtime.limited for o in observers):
        return np.stack([run_carefully(o, y, u, parameters, Estimate.PREDICT) for o in observers])
    n, n_lifted, m, k = lifting.n_states, lifting.n_lifted, observer.B.shape[1], len(observers)
    order = max(o.controller.n_states for o in observers)
    values = {**observer.parameters, **(parameters or {})}
    step = np.stack([_padded(o, order) for o in observers])
    # One column a machine, so that each quantity of all machines lies together: [theta, x^c, u, y]. The product gives [x_hat+, x^c+].
    column = np.zeros((k, step.shape[2], batch))
    row = np.swapaxes(column, 1, 2)
    lifted, inflow, measurement = row[..., :n_lifted], row[..., n_lifted + order : n_lifted + order + m], row[..., n_lifted + order + m :]
    for own, first in zip(row, observers, strict=True):
        own[..., :n] = first.initial(y[0], parameters)
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
    return estimates.transpose(1, 0, 3, 2)


def require_recordings(who: str, inputs: Sequence[str], y: Array, u: Array) -> None:
    """Refuse measurements and inputs that do not fit together, or to the inputs of an observer."""
    if y.ndim != 3 or u.ndim != 3 or y.shape[:2] != u.shape[:2]:
        raise DimensionError(f"Running {who}: measurements {y.shape} and inputs {u.shape} should agree in (n_samples, batch).")
    if u.shape[2] != len(inputs):
        raise DimensionError(f"Running {who}: expected inputs {tuple(inputs)}, found shape {u.shape}.")


def _padded(observer: Observer, order: int) -> Array:
    """The one-step map with silent controller states up to an order."""
    n, nl, own = observer.lifting.n_states, observer.lifting.n_lifted, observer.controller.n_states
    missing = order - own
    step = np.insert(observer.one_step, [nl + own] * missing, 0.0, axis=1)
    return np.ascontiguousarray(np.insert(step, [n + own] * missing, 0.0, axis=0))
