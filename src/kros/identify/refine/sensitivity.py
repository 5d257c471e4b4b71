"""Free runs with analytic sensitivities: how the run's states move with the model, batched over units and their segments.

A model is ``x+ = W psi``, with ``psi = [x; sigma(x); u]``. Lifted states are re-lifted at every step, so that

    dx+/dV = F dx/dV + (dW/dV) psi,      F = W d psi/dx,      W = V T^T

where the columns of T whiten the data; all least squares is done in V, whose entries are of one size.

Symbols
-------
V       : free parameters, (unit, n, p), with p = n_lifted + m;   T : whitening, (p, p)
S       : sensitivities dx/dV, (n, n p, batch), with the batch last so that every operation runs over contiguous memory
normal  : ``[J r]^T [J r]`` of every unit, (unit, n p + 1, n p + 1), over the residuals r = (x_data - x) / sigma
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from ...lifting import Lifting
from .segments import Segments

Array = npt.NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Normal:
    """Normal equations of every unit.

    Parameters
    ----------
    matrix : ndarray, shape (unit, n p + 1, n p + 1)
        ``[J r]^T [J r]``; infinite where a run diverged.
    squares : ndarray, shape (unit, n)
        Sum of squared errors of every state, not scaled.
    counts : ndarray, shape (unit,)
        Number of residuals of one state.
    """

    matrix: Array
    squares: Array
    counts: Array

    @property
    def cost(self) -> Array:
        """Sum of squared scaled residuals, shape (unit,)."""
        return self.matrix[:, -1, -1]


def normal_equations(
    V: Array, T: Array, lifting: Lifting, parameters: Mapping[str, Array], segments: Segments, sigma: Array, stride: int = 1
) -> Normal:
    """Run all segments with their unit's model and accumulate the normal equations.

    Parameters
    ----------
    V : ndarray, shape (unit, n, p)
    T : ndarray, shape (p, p)
    lifting : Lifting
    parameters : mapping of str to ndarray, shape (unit,)
    segments : Segments
    sigma : ndarray, shape (n,)
        Scale of every state's error.
    stride : int
        Every how many steps the error counts.

    Returns
    -------
    Normal
    """
    n, nl = lifting.n_states, lifting.n_lifted
    n_samples, m, units, per_unit = segments.inputs.shape
    batch, p = units * per_unit, nl + m
    own = {name: np.repeat(values, per_unit) for name, values in parameters.items()}
    W = np.repeat(np.moveaxis(V @ T.T, 0, -1), per_unit, axis=-1)  # (n, p, batch)
    x = segments.states.reshape(n_samples, n, batch)
    u = segments.inputs.reshape(n_samples, m, batch)
    valid = segments.valid.reshape(n_samples, batch)
    psi, S, S_next = np.empty((p, batch)), np.zeros((n, n * p, batch)), np.empty((n, n * p, batch))
    work, F = np.empty((n * p, batch)), np.empty((n, n, batch))
    psi[:n] = x[0]
    matrix, squares, counts = np.zeros((units, n * p + 1, n * p + 1)), np.zeros((n, units)), np.zeros(units)
    with np.errstate(over="ignore", invalid="ignore"):
        for k in range(n_samples - 1):
            lifting.lift_into(psi[:nl].T, own)
            psi[nl:] = u[k]
            _state_matrix(F, W, psi, lifting, own)
            _advance(S_next, S, F, T.T @ psi, work)
            S, S_next = S_next, S
            psi[:n] = np.einsum("apb,pb->ab", W, psi)
            if (k + 1) % stride == 0:
                error = np.where(valid[k + 1], x[k + 1] - psi[:n], 0.0)
                squares += (error**2).reshape(n, units, per_unit).sum(axis=-1)
                counts += valid[k + 1].reshape(units, per_unit).sum(axis=-1)
                _accumulate(matrix, S, error, valid[k + 1], sigma, units)
    matrix[~np.isfinite(matrix).all(axis=(1, 2))] = np.inf
    return Normal(matrix, squares.T, counts)


def _state_matrix(F: Array, W: Array, psi: Array, lifting: Lifting, parameters: Mapping[str, Array]) -> None:
    """F = W d psi/dx, shape (n, n, batch)."""
    n, nl = lifting.n_states, lifting.n_lifted
    F[:] = W[:, :n]
    if lifting.functions:
        slopes = lifting.slopes(psi[:n].T, parameters)  # (batch, function, n)
        F += np.einsum("afb,bfj->ajb", W[:, n:nl], slopes)


def _advance(S_next: Array, S: Array, F: Array, white: Array, work: Array) -> None:
    """S_next = F S + (dV) white."""
    n, p = len(F), len(white)
    for a in range(n):
        np.multiply(S[0], F[a, 0], out=S_next[a])
        for b in range(1, n):
            np.multiply(S[b], F[a, b], out=work)
            np.add(S_next[a], work, out=S_next[a])
        S_next[a, a * p : (a + 1) * p] += white


def _accumulate(matrix: Array, S: Array, error: Array, valid: npt.NDArray[np.bool_], sigma: Array, units: int) -> None:
    """Add [J r]^T [J r] of one sample; J = dx/dV / sigma."""
    rows = np.concatenate([S, error[:, None]], axis=1) / sigma[:, None, None]  # (n, n p + 1, batch)
    if not valid.all():
        rows[:, :, ~valid] = 0.0
    n, width, batch = rows.shape
    J = rows.reshape(n, width, units, batch // units).transpose(2, 1, 0, 3).reshape(units, width, -1)
    matrix += J @ np.swapaxes(J, -1, -2)
