"""Free run of lifted models: from a first state and recorded inputs alone, retracted and re-lifted at every step.

The definition is the *local error* of the paper's section III: the lifted state always has the structure of a lifting.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
import numpy.typing as npt

from ..core.errors import DimensionError
from ..lifting import Lifting

Array = npt.NDArray[np.float64]


def free_run(A: Array, B: Array, lifting: Lifting, parameters: Mapping[str, npt.ArrayLike], x0: Array, u: Array) -> Array:
    """Simulate a batch of models, one Python step per sample for the whole batch.

    Parameters
    ----------
    A : ndarray, shape (batch, n, n) or (n, n)
    B : ndarray, shape (batch, n, m) or (n, m)
    lifting : Lifting
    parameters : mapping of str to array_like, shape (batch,)
    x0 : ndarray, shape (batch, n_states)
    u : ndarray, shape (batch, n_samples, m)

    Returns
    -------
    ndarray, shape (batch, n_samples, n_states)
        The state at sample k follows from inputs up to k - 1; the first is `x0`. A run that diverges holds infinities or NaN.
    """
    batch, n_samples, m = u.shape
    n, n_lifted = lifting.n_states, lifting.n_lifted
    if x0.shape != (batch, n) or A.shape[-1] != n_lifted or B.shape[-1] != m:
        raise DimensionError(
            f"Free run: inputs {u.shape}, first states {x0.shape}, A {A.shape} and B {B.shape} do not fit a lifting of {n} states to {n_lifted}."
        )
    step = np.ascontiguousarray(np.swapaxes(np.concatenate([A, B], axis=-1)[..., :n, :], -1, -2))  # (.., n_lifted + m, n)
    psi = np.empty((batch, n_lifted + m))
    states = np.empty((n_samples, batch, n))
    inputs = np.ascontiguousarray(np.swapaxes(u, 0, 1))
    psi[:, :n] = x0
    lifted = psi[:, :n_lifted]
    with np.errstate(over="ignore", invalid="ignore"):
        for k in range(n_samples):
            states[k] = psi[:, :n]
            lifting.lift_into(lifted, parameters)
            psi[:, n_lifted:] = inputs[k]
            psi[:, :n] = psi @ step if step.ndim == 2 else (psi[:, None, :] @ step)[:, 0, :]
    return np.swapaxes(states, 0, 1)
