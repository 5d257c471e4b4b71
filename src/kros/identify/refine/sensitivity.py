"""Free runs with analytic sensitivities: how the run's states move with the model, batched over units and their segments.

A model is ``x+ = W psi``, with ``psi = [x; sigma(w); u; v(w, u)]`` on the window w, the states x and the earlier values of states and inputs
that the lifting reads. Lifted states are re-lifted at every step, so that

    dx+/dV = sum over d of F_d S_d + (dW/dV) psi,      F_d = W d psi/dx[-d],      W = V T^T

where the columns of T whiten the data; all least squares is done in V, whose entries are of one size. Without delays d is 0 alone. Values
that were recorded, all inputs and the states of the first window, do not move with the model.

Symbols
-------
V       : free parameters, (unit, n, p), with p = n_lifted + m, input functions counted;   T : whitening, (p, p)
S_d     : sensitivities dx/dV of d samples ago, (n, n p, batch), the batch last so that every operation runs over contiguous memory
F       : F_0, and behind it the columns of every F_d of the states that the lifting reads d samples ago, (n, n + q, batch)
normal  : ``[J r]^T [J r]`` of every unit, (unit, n p + 1, n p + 1), over the residuals r = (x_data - x) / sigma
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from ...lifting import Lifting
from .segments import Segments

Array = npt.NDArray[np.float64]
Past = tuple[int, int, int]


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
    """Run all segments with their unit's model and accumulate the normal equations, errors in units of sigma (n,), at every `stride`-th step."""
    n, nl, h = lifting.n_states, lifting.n_lifted, segments.history
    n_samples, m, units, per_unit = segments.inputs.shape
    batch, p = units * per_unit, V.shape[-1]
    own = {name: np.repeat(values, per_unit) for name, values in parameters.items()}
    W = np.repeat(np.moveaxis(V @ T.T, 0, -1), per_unit, axis=-1)  # (n, p, batch)
    x = segments.states.reshape(n_samples, n, batch)
    u = segments.inputs.reshape(n_samples, m, batch)
    valid = segments.valid.reshape(n_samples, batch)
    past = _moving_past(lifting)
    psi, work, F = np.empty((p, batch)), np.empty((n * p, batch)), np.empty((n, n + len(past), batch))
    S = [np.zeros((n, n * p, batch)) for _ in range(2 + max((d for _, _, d in past), default=0))]  # now, earlier, and space for the next
    window = np.empty((len(lifting.window.names), batch)) if h else psi[:n]
    window[:] = lifting.windows(x[: h + 1].transpose(2, 0, 1), u[: h + 1].transpose(2, 0, 1))[:, 0].T
    psi[:n] = window[:n]
    matrix, squares, counts = np.zeros((units, n * p + 1, n * p + 1)), np.zeros((n, units)), np.zeros(units)
    with np.errstate(over="ignore", invalid="ignore"):
        for k in range(h, n_samples - 1):
            lifting.lift_into(psi[:nl].T, own, window[n:].T)
            psi[nl:] = lifting.lift_inputs(u[k].T, window.T, own).T
            _state_matrix(F, W, window, u[k], lifting, own, past)
            _advance(S, F, T.T @ psi, work, past)
            if h:
                window[n:] = lifting.window.advance(window.T, u[k].T).T
            psi[:n] = window[:n] = np.einsum("apb,pb->ab", W, psi)
            S = [S[-1], *S[:-1]]
            if (k + 1 - h) % stride == 0:
                error = np.where(valid[k + 1], x[k + 1] - psi[:n], 0.0)
                squares += (error**2).reshape(n, units, per_unit).sum(axis=-1)
                counts += valid[k + 1].reshape(units, per_unit).sum(axis=-1)
                _accumulate(matrix, S[0], error, valid[k + 1], sigma, units)
    matrix[~np.isfinite(matrix).all(axis=(1, 2))] = np.inf
    return Normal(matrix, squares.T, counts)


def _moving_past(lifting: Lifting) -> list[Past]:
    """Earlier values of states that a formula reads: entry of the window, state and delay."""
    read = {name for formula in (*lifting.formulas, *lifting.input_formulas) for name in formula.used}
    window, states = lifting.window, lifting.states
    return [
        (entry, states.index(quantity), delay)
        for entry, (quantity, delay) in enumerate(window.quantities)
        if delay and window.names[entry] in read and quantity in states
    ]


def _state_matrix(
    F: Array, W: Array, window: Array, u: Array, lifting: Lifting, parameters: Mapping[str, Array], past: Sequence[Past]
) -> None:
    """F = W d psi/dw, shape (n, n + q, batch)."""
    n, nl = lifting.n_states, lifting.n_lifted
    moving = [*range(n), *(entry for entry, _, _ in past)] if len(window) > n else slice(None)
    F[:, :n], F[:, n:] = W[:, :n], 0.0
    if lifting.functions:
        slopes = lifting.slopes(window.T, parameters)[..., moving]  # (batch, function, n + q)
        F += np.einsum("afb,bfj->ajb", W[:, n:nl], slopes)
    if lifting.input_functions:
        slopes = lifting.input_slopes(u.T, window.T, parameters)[..., moving]
        F += np.einsum("afb,bfj->ajb", W[:, nl + len(u) :], slopes)


def _advance(S: Sequence[Array], F: Array, white: Array, work: Array, past: Sequence[Past]) -> None:
    """S_next = sum over d of F_d S_d + (dV) white, with S_next in the place of the oldest."""
    p = len(white)
    terms = [*S[0], *(S[delay][state] for _, state, delay in past)]
    for a, into in enumerate(S[-1]):
        np.multiply(terms[0], F[a, 0], out=into)
        for b in range(1, len(terms)):
            np.multiply(terms[b], F[a, b], out=work)
            np.add(into, work, out=into)
        into[a * p : (a + 1) * p] += white


def _accumulate(matrix: Array, S: Array, error: Array, valid: npt.NDArray[np.bool_], sigma: Array, units: int) -> None:
    """Add [J r]^T [J r] of one sample; J = dx/dV / sigma."""
    rows = np.concatenate([S, error[:, None]], axis=1) / sigma[:, None, None]  # (n, n p + 1, batch)
    if not valid.all():
        rows[:, :, ~valid] = 0.0
    n, width, batch = rows.shape
    J = rows.reshape(n, width, units, batch // units).transpose(2, 1, 0, 3).reshape(units, width, -1)
    matrix += J @ np.swapaxes(J, -1, -2)
