"""Simulation of models from a first state and inputs alone, lifted ones retracted and re-lifted at every step.

The definition is the *local error* of the paper's section III: the lifted state always has the structure of a lifting.
"""

from collections.abc import Mapping

import numpy as np

from ..core import Array, ArrayLike, DimensionError
from ..lifting import Lifting
from ..loops import formulas, library


def free_run(A: Array, B: Array, lifting: Lifting, parameters: Mapping[str, ArrayLike], x0: Array, u: Array) -> Array:
    """Simulate a batch of models, compiled where there is a compiler.

    Parameters
    ----------
    A, B : ndarray, shapes (batch, n, n) and (batch, n, m), or without the batch
        With input functions, m counts them.
    lifting : Lifting
    parameters : mapping of str to array_like, shape (batch,)
    x0 : ndarray, shape (batch, n_states), or (batch, history + 1, n_states) for a lifting with delays
        The first recorded states.
    u : ndarray, shape (batch, n_samples, m)
        Recorded inputs.

    Returns
    -------
    ndarray, shape (batch, n_samples, n_states)
        The state at sample k follows from inputs up to k - 1; the first ones are `x0`. A run that diverges holds
        infinities or NaN.

    Raises
    ------
    DimensionError, DataError
        When shapes do not fit together, or there are fewer samples than the history needs.

    Examples
    --------
    >>> import numpy as np
    >>> from kros.identify import free_run
    >>> from kros.lifting import Lifting
    >>> A, B, u = np.array([[0.5]]), np.array([[1.0]]), np.zeros((1, 4, 1))
    >>> run = free_run(A, B, Lifting(("x",)), {}, np.array([[8.0]]), u)
    >>> run.ravel().tolist()
    [8.0, 4.0, 2.0, 1.0]
    """
    batch, n_samples, m = u.shape
    n, n_lifted, h = lifting.n_states, lifting.n_lifted, lifting.history
    first = x0[:, None] if x0.ndim == 2 else x0
    width = m + len(lifting.input_functions)
    if first.shape != (batch, h + 1, n) or A.shape[-1] != n_lifted or B.shape[-1] != width:
        past = f" with a history of {h} samples" if h else ""
        raise DimensionError(
            f"Free run: inputs {u.shape}, first states {x0.shape}, A {A.shape} and B {B.shape} do not fit a lifting of "
            f"{n} states to {n_lifted}{past} and {width} inputs."
        )
    lifting.window.require(n_samples)
    rows, window = np.concatenate([A, B], axis=-1)[..., :n, :], lifting.windows(first, u[:, : h + 1])[:, 0].copy()
    if (loops := library()) is not None:
        column, states = np.zeros((width + n_lifted, batch)), np.empty((n_samples, n, batch))
        column[:n], states[:h] = window[:, :n].T, first[:, :h].transpose(1, 2, 0)
        job = {"samples": n_samples - h, "batch": batch, "own": rows.ndim == 3, "map": rows}
        job |= {"u": u[:, h:].transpose(1, 2, 0), "column": column, "states": states[h:]}
        job["past"] = np.ascontiguousarray(window[:, n:])
        loops.call("kros_relift", formulas(lifting, parameters, m, batch), ("relift_job", job))
        return states.transpose(2, 0, 1)
    states = np.empty((batch, n_samples, n))
    states[:, :h] = first[:, :h]
    with np.errstate(over="ignore", invalid="ignore"):
        for k in range(h, n_samples):  # ``x+ = [A B] psi(w)`` for the states alone
            states[:, k] = window[:, :n]
            lifted, inputs = lifting.lift(window, parameters), lifting.lift_inputs(u[:, k], window, parameters)
            window[:, n:] = lifting.window.advance(window, u[:, k])
            window[:, :n] = (rows @ np.concatenate([lifted, inputs], axis=1)[..., None])[..., 0]
    return states


def recursion(A: Array, B: Array, first: Array, u: Array) -> Array:
    """Return ``x[k + 1] = A x[k] + B u[k]``, shape (n_samples, batch, n), from u (n_samples, batch, m)."""
    if not len(A):
        return np.zeros((*u.shape[:2], 0))
    states = Lifting(tuple(f"x{i}" for i in range(len(A))))
    return free_run(A, B, states, {}, first, u.swapaxes(0, 1)).swapaxes(0, 1)
