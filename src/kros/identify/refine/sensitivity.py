"""Free runs with analytic sensitivities: how the states move with the model, batched over units and segments.

A model is ``x+ = W psi``, with ``psi = [x; sigma(w); u; v(w, u)]`` on the window w, the states x and the earlier values
of states and inputs that the lifting reads. Lifted states are re-lifted at every step, so that

    dx+/dV = sum over d of F_d S_d + (dW/dV) psi,      F_d = W d psi/dx[-d],      W = V T^T

where the columns of T whiten the data; all least squares is done in V, whose entries are of one size. Without delays d
is 0 alone. Values that were recorded, all inputs and the states of the first window, do not move with the model.

Symbols
-------
V       : free parameters, (unit, n, p), with p = n_lifted + m, input functions counted;   T : whitening, (p, p)
S_d     : sensitivities dx/dV of d samples ago, (n, n p, batch), the batch last for contiguous memory
F       : F_0, and behind it the columns of every F_d that the lifting reads, (n, n + q, batch)
normal  : ``[J r]^T [J r]`` of every unit, (unit, n p + 1, n p + 1), over the residuals r = (x_data - x) / sigma
"""

from collections.abc import Iterator, Mapping, Sequence

import numpy as np

from ...core import Array, Flags, frozen
from ...lifting import Lifting
from ...loops import Library, formulas, library
from .segments import Segments

Past = tuple[int, int, int]
_AT_ONCE = 500_000  # numbers in memory: residuals and how they move


@frozen
class Normal:
    """Normal equations of every unit."""

    matrix: Array  # (unit, n p + 1, n p + 1)
    squares: Array  # (unit, n)
    counts: Array  # (unit,)

    @property
    def cost(self) -> Array:
        """Sum of squared scaled residuals, shape (unit,)."""
        return self.matrix[:, -1, -1]


def normal_equations(
    V: Array, T: Array, lifting: Lifting, parameters: Mapping[str, Array], segments: Segments, sigma: Array, stride: int
) -> Normal:
    """Run all segments with their unit's model; add up normal equations over sigma (n,), every `stride` steps."""
    n, h = lifting.n_states, segments.history
    n_samples, m, units, per_unit = segments.inputs.shape
    batch, width = units * per_unit, n * V.shape[-1] + 1
    values = {name: np.repeat(given, per_unit) for name, given in parameters.items()}
    W = np.repeat(np.moveaxis(V @ T.T, 0, -1), per_unit, axis=-1)  # (n, p, batch)
    x, u = segments.states.reshape(n_samples, n, batch), segments.inputs.reshape(n_samples, m, batch)
    window = lifting.windows(x[: h + 1].transpose(2, 0, 1), u[: h + 1].transpose(2, 0, 1))[:, 0].T.copy()
    run = _Run(W, T, lifting, values, x, u, segments.valid.reshape(n_samples, batch), sigma, stride, units)
    matrix, squares = np.zeros((units, width, width)), np.zeros((units, n))
    with np.errstate(over="ignore", invalid="ignore"):
        for J in run.rows(window):
            matrix += J @ J.mT
            squares += (J[:, -1].reshape(units, -1, n, per_unit) ** 2).sum(axis=(1, 3)) * sigma**2
    matrix[~np.isfinite(matrix).all(axis=(1, 2))] = np.inf
    return Normal(matrix, squares, segments.compared[stride - 1 :: stride].sum(axis=(0, 2)).astype(float))


@frozen
class _Run:
    """Free runs of all segments: models W (n, p, batch), recordings x (sample, n, batch) and u (sample, m, batch)."""

    W: Array
    T: Array
    lifting: Lifting
    parameters: Mapping[str, Array]
    x: Array
    u: Array
    valid: Flags
    sigma: Array
    stride: int
    units: int

    def rows(self, window: Array) -> Iterator[Array]:
        """Yield ``[J r]^T`` of some samples after the other, shape (unit, n p + 1, residuals), from a window on."""
        n, p, batch = self.W.shape
        lifting = self.lifting
        past = [  # earlier values of states: entry of the window, state and delay
            (entry, lifting.states.index(quantity), delay)
            for entry, (quantity, delay) in enumerate(lifting.window.quantities)
            if delay and quantity in lifting.states
        ]
        depth = 2 + max((d for _, _, d in past), default=0)  # now, earlier, and space for the next
        S = np.zeros((depth, n, n * p, batch))
        if (loops := library()) is not None:
            yield from self._compiled(loops, window, S, past)
            return
        nl, h = lifting.n_lifted, lifting.history
        psi, recent = np.empty((p, batch)), list(S)
        psi[:n] = window[:n]
        for k in range(h, len(self.x) - 1):
            u = self.u[k]
            psi[:nl] = lifting.lift(window.T, self.parameters).T
            psi[nl:] = lifting.lift_inputs(u.T, window.T, self.parameters).T
            terms = np.stack([*recent[0], *(recent[delay][state] for _, state, delay in past)])
            following = np.einsum("abj,bqj->aqj", self._state_matrix(window, u, past), terms)
            following.reshape(n, n, p, batch)[range(n), range(n)] += self.T.T @ psi
            window[n:] = lifting.window.advance(window.T, u.T).T
            psi[:n] = window[:n] = np.einsum("apb,pb->ab", self.W, psi)
            recent = [following, *recent[:-1]]
            if (k + 1 - h) % self.stride == 0:
                error = self.x[k + 1] - psi[:n]
                rows = np.concatenate([following, error[:, None]], axis=1) / self.sigma[:, None, None]
                rows[:, :, ~self.valid[k + 1]] = 0.0
                by_unit = rows.reshape(n, n * p + 1, self.units, batch // self.units).transpose(2, 1, 0, 3)
                yield by_unit.reshape(self.units, n * p + 1, -1)

    def _compiled(self, loops: Library, window: Array, S: Array, past: Sequence[Past]) -> Iterator[Array]:
        (n, p, batch), lifting, h, m = self.W.shape, self.lifting, self.lifting.history, self.u.shape[1]
        per_unit, total = batch // self.units, (len(self.x) - 1 - h) // self.stride
        entries = (*range(n), *(entry for entry, _, _ in past))
        term = [*((state, 0) for state in range(n)), *((state, delay) for _, state, delay in past)]
        job = {"samples": len(self.x), "batch": batch, "per_unit": per_unit, "history": h, "stride": self.stride}
        job |= {"terms": len(entries), "depth": len(S), "term": term, "window": window, "S": S}
        job |= {name: getattr(self, name) for name in ("W", "T", "x", "u", "valid", "sigma")}
        of_lifting = formulas(lifting, self.parameters, m, batch, entries)
        together = max(1, _AT_ONCE // (batch * n * (n * p + 1)))
        for start in range(0, total, together):
            count, first = min(together, total - start), h + start * self.stride
            J = np.empty((self.units, n * p + 1, count * n * per_unit))
            part = {"first": first, "last": first + count * self.stride, "rows": count, "J": J}
            loops.call("kros_sensitivities", of_lifting, ("sensitivity_job", job | part))
            yield J

    def _state_matrix(self, window: Array, u: Array, past: Sequence[Past]) -> Array:
        """F = W d psi/dw, shape (n, n + q, batch)."""
        lifting, W, n, nl = self.lifting, self.W, self.lifting.n_states, self.lifting.n_lifted
        moving = [*range(n), *(entry for entry, _, _ in past)]
        F = np.zeros((n, len(moving), window.shape[1]))
        F[:, :n] = W[:, :n]
        if lifting.functions:
            slopes = lifting.slopes(window.T, self.parameters)[..., moving]  # (batch, function, n + q)
            F += np.einsum("afb,bfj->ajb", W[:, n:nl], slopes)
        if lifting.input_functions:
            slopes = lifting.slopes(window.T, self.parameters, u=u.T)[..., moving]
            F += np.einsum("afb,bfj->ajb", W[:, nl + len(u) :], slopes)
        return F
