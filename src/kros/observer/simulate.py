"""Batched simulation of an observer over many episodes at once."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
import numpy.typing as npt

from ..core.errors import DimensionError
from .observer import Observer

Array = npt.NDArray[np.float64]


def run_observer(observer: Observer, y: Array, u: Array, parameters: Mapping[str, npt.ArrayLike] | None = None) -> Array:
    """Run an observer over a batch of episodes, one Python step per sample for the whole batch.

    Parameters
    ----------
    observer : Observer
    y : ndarray, shape (n_samples, batch, q)
    u : ndarray, shape (n_samples, batch, m)
    parameters : mapping of str to array_like, shape (batch,)
        Lifting parameters of the machine behind each episode; the observer's own where absent.

    Returns
    -------
    ndarray, shape (n_samples, batch, n)
        Row k is the estimate of the state at k from data up to k - 1; row 0 is the start.
    """
    if y.ndim != 3 or u.ndim != 3 or y.shape[:2] != u.shape[:2]:
        raise DimensionError(
            f"Running observer {observer.name}: measurements {y.shape} and inputs {u.shape} should agree in (n_samples, batch)."
        )
    lifting, n_samples, batch = observer.lifting, *y.shape[:2]
    n, n_lifted, order, m = lifting.n_states, lifting.n_lifted, observer.controller.n_states, observer.B.shape[1]
    if u.shape[2] != len(observer.inputs):
        raise DimensionError(f"Running observer {observer.name}: expected inputs {observer.inputs}, found shape {u.shape}.")
    values = {**observer.parameters, **(parameters or {})}
    step = np.ascontiguousarray(observer.one_step.T)
    # One row a machine: [theta, x^c, u, y]. The product gives [x_hat+, x^c+].
    row = np.zeros((batch, step.shape[0]))
    lifted = row[:, :n_lifted]
    row[:, :n] = observer.initial(y[0])
    estimates = np.empty((n_samples, batch, n))
    following = np.empty((batch, n + order))
    plain = not (lifting.history or lifting.input_functions)
    earlier = lifting.window.hold(row[:, :n], u[0])
    with np.errstate(over="ignore", invalid="ignore"):
        for k in range(n_samples):
            estimates[k] = row[:, :n]
            if plain:
                lifting.lift_into(lifted, values)
                row[:, n_lifted + order : n_lifted + order + m] = u[k]
            else:
                window = np.concatenate([row[:, :n], earlier], axis=-1)
                lifting.lift_into(lifted, values, earlier)
                row[:, n_lifted + order : n_lifted + order + m] = lifting.lift_inputs(u[k], window, values)
                earlier = lifting.window.advance(window, u[k])
            row[:, n_lifted + order + m :] = y[k]
            np.matmul(row, step, out=following)
            row[:, :n] = following[:, :n]
            row[:, n_lifted : n_lifted + order] = following[:, n:]
    return estimates
