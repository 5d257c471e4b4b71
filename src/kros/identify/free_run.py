"""Free run of lifted models: from a first state and recorded inputs alone, retracted and re-lifted at every step.

The definition is the *local error* of the paper's section III: the lifted state always has the structure of a lifting.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
import numpy.typing as npt

from ..core.errors import DimensionError
from ..lifting import Lifting
from ..loops import Library, formulas, library, tape_of

Array = npt.NDArray[np.float64]


def free_run(
    A: Array, B: Array, lifting: Lifting, parameters: Mapping[str, npt.ArrayLike], x0: Array, u: Array
) -> Array:
    """Simulate a batch of models, compiled where there is a compiler.

    Parameters
    ----------
    A : ndarray, shape (batch, n, n) or (n, n)
    B : ndarray, shape (batch, n, m) or (n, m)
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
        The state at sample k follows from inputs up to k - 1; the first ones are `x0`. A run that diverges holds infinities or NaN.

    Raises
    ------
    DimensionError
        When shapes do not fit together.
    DataError
        When there are fewer samples than the history needs.

    Examples
    --------
    >>> import numpy as np
    >>> from kros.identify import free_run
    >>> from kros.lifting import Lifting
    >>> run = free_run(np.array([[0.5]]), np.array([[1.0]]), Lifting(("x",)), {}, np.array([[8.0]]), np.zeros((1, 4, 1)))
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
            f"Free run: inputs {u.shape}, first states {x0.shape}, A {A.shape} and B {B.shape} do not fit a lifting of {n} states to {n_lifted}"
            f"{past} and {width} inputs."
        )
    lifting.window.require(n_samples)
    if (loops := library()) is not None:
        return _compiled(loops, A, B, lifting, parameters, first, u)
    step = np.ascontiguousarray(
        np.swapaxes(np.concatenate([A, B], axis=-1)[..., :n, :], -1, -2)
    )  # (.., n_lifted + m, n)
    psi = np.empty((batch, n_lifted + width))
    states = np.empty((n_samples, batch, n))
    states[: h + 1] = np.swapaxes(first, 0, 1)
    inputs = np.ascontiguousarray(np.swapaxes(u, 0, 1))
    psi[:, :n] = first[:, h]
    lifted = psi[:, :n_lifted]
    advance = _multiply_all if step.ndim == 2 else _multiply_each
    with np.errstate(over="ignore", invalid="ignore"):
        if not (h or lifting.input_functions):
            for k in range(n_samples):
                states[k] = psi[:, :n]
                lifting.lift_into(lifted, parameters)
                psi[:, n_lifted:] = inputs[k]
                psi[:, :n] = advance(psi, step)
            return np.swapaxes(states, 0, 1)
        earlier = lifting.windows(first, u[:, : h + 1])[:, 0, n:]
        for k in range(h, n_samples):
            states[k] = psi[:, :n]
            window = np.concatenate([psi[:, :n], earlier], axis=-1)
            lifting.lift_into(lifted, parameters, earlier)
            psi[:, n_lifted:] = lifting.lift_inputs(inputs[k], window, parameters)
            earlier = lifting.window.advance(window, inputs[k])
            psi[:, :n] = advance(psi, step)
    return np.swapaxes(states, 0, 1)


def _compiled(
    loops: Library,
    A: Array,
    B: Array,
    lifting: Lifting,
    parameters: Mapping[str, npt.ArrayLike],
    first: Array,
    u: Array,
) -> Array:
    batch, n_samples, m = u.shape
    n, h, rows = lifting.n_states, lifting.history, np.concatenate([A, B], axis=-1)[..., : lifting.n_states, :]
    window = lifting.windows(first, u[:, : h + 1])[:, 0]
    column = np.zeros((rows.shape[-1], batch))
    column[:n] = window[:, :n].T
    states = np.empty((n_samples, n, batch))
    states[:h] = first[:, :h].transpose(1, 2, 0)
    job = {
        "observers": 1,
        "samples": n_samples - h,
        "batch": batch,
        "own": rows.ndim == 3,
        "map": rows,
        "u": u[:, h:].transpose(1, 2, 0),
        "column": column,
        "past": np.ascontiguousarray(window[:, n:]),
        "states": states[h:],
    }
    loops.call("kros_relift", formulas(lifting, tape_of(lifting, m), parameters, m, batch), ("relift_job", job))
    return states.transpose(2, 0, 1)


def _multiply_all(psi: Array, step: Array) -> Array:
    return psi @ step


def _multiply_each(psi: Array, step: Array) -> Array:
    return np.asarray((psi[:, None, :] @ step)[:, 0, :])
