r"""Fewer states: balanced truncation of a bank with its readout, controllability taken from the recordings.

With L the root of the observability Gramian and P the recordings' second moment of the bank, the principal directions
of :math:`L P L^T` carry the squared singular values. The projection is orthogonal in the metric of the observability
Gramian, in which A is a contraction, so that the result is stable whatever P is (B. C. Moore, IEEE Trans. Autom.
Control 26 (1981) 17-32; L. Pernebo and L. M. Silverman, ibid. 27 (1982) 382-387).

What remains runs in the coordinates of its modes, where A is block diagonal: two multiplications for every state.
"""

from __future__ import annotations

from bisect import bisect_left
from dataclasses import field, replace

import numpy as np

from ...core import EPS, Array, frozen
from ...core.linalg import balanced_size, qr_triangle
from ...core.norms import gramian_root
from ...identify.free_run import recursion
from .channels import Channels
from .regression import Readout

_EPISODES = 8
_ALIKE = 1e4  # condition of modes, by which rounding grows, up to which they are coordinates


@frozen
class Filters:
    """Filters with a readout: ``z+ = A z + B w``, estimate ``C z + D w``, ``z = S w`` at the first sample."""

    A: Array  # (r, r)
    B: Array  # (r, channels)
    C: Array  # (n, r)
    D: Array  # (n, channels)
    S: Array  # (r, channels)
    singular_values: Array = field(default_factory=lambda: np.zeros(0))  # before reduction, over errors of estimates

    def first(self, order: int) -> Filters:
        """Return the first states alone."""
        A, B, C, S = self.A[:order, :order], self.B[:order], self.C[:, :order], self.S[:order]
        return replace(self, A=A, B=B, C=C, S=S)

    def modal(self) -> Filters:
        """Return the filters in the coordinates of their modes, or as they are where modes are nearly alike."""
        from scipy.linalg import block_diag

        size = balanced_size(self.A)
        values, vectors = np.linalg.eig(self.A / size[:, None] * size)
        upper = np.flatnonzero(values.imag >= 0)
        parts = [[vectors[:, i].real, vectors[:, i].imag][: 1 + bool(values[i].imag)] for i in upper]
        modes = np.array([part for pair in parts for part in pair]).T
        if not self.A.size or np.linalg.cond(modes) > _ALIKE:
            return self
        blocks = [[[v.real, v.imag], [-v.imag, v.real]] if v.imag else [[v.real]] for v in values[upper]]
        B, S = (np.linalg.solve(modes, into / size[:, None]) for into in (self.B, self.S))
        return replace(self, A=block_diag(*blocks), B=B, C=self.C * size @ modes, S=S)

    def absolute(self, channels: Channels) -> Filters:
        """Return the filters of channels v, where these are of what ``channels.filtered(v)`` returns."""
        N, E = channels.relative
        D = self.D @ N
        D.reshape(-1, channels.lifting.n_states, len(channels))[:, channels.measured] += channels.reference
        k = E.shape[1]
        A = np.block([[np.zeros((k, k + len(self.A)))], [-self.B @ E, self.A]])
        B, S = np.vstack([E.T, self.B @ N]), np.vstack([E.T, self.S @ (N - E @ E.T)])
        return replace(self, A=A, B=B, C=np.hstack([-self.D @ E, self.C]), D=D, S=S)

    def along(self, v: Array) -> Array:
        """Return the estimates of signals v (n_samples, batch, channels), shape (n_samples, batch, n)."""
        z = recursion(self.A, self.B, v[0] @ self.S.T, v)
        return z @ self.C.T + v @ self.D.T


def reduced(readout: Readout, order: int | None = None) -> Filters:
    """Return the filters of a readout, reduced until left-out errors grow by a share, or to an order.

    The covariance is that of thinned rows of the bank.
    """
    design, coefficients = readout.design, readout.coefficients
    errors = readout.typical * design.recordings.size
    errors[list(design.channels.measured)] *= design.settings.measured_loss
    errors = np.tile(errors, coefficients.shape[1] // len(errors))
    A, B, S = design.bank.system()
    size = np.linalg.norm(readout.sample, axis=0)
    size = np.where(size > 0, size, 1.0)
    A, B, S = A * size / size[:, None], B / size[:, None], S / size[:, None]
    C = coefficients.T * size @ A
    D = coefficients.T * size @ B
    used = np.isfinite(errors) & (errors > 0)
    root = observability_root(A, C[used] / errors[used, None], design.bank.delays)
    _, values, U = np.linalg.svd(root, full_matrices=False)
    kept = values > EPS * values[0]
    L, inverse = values[kept, None] * U[kept], U[kept].T / values[kept]
    _, sigma, V = np.linalg.svd(readout.sample / size @ L.T, full_matrices=False)
    scale = np.maximum(sigma, EPS * sigma[:1])  # states of RMS one
    left, right = (V @ L) / scale[:, None], (inverse @ V.T) * scale
    whole = Filters(left @ A @ right, left @ B, C @ right, D, left @ S, sigma)
    if order is not None:
        return whole.first(order).modal()
    signals = design.sample_signals(_EPISODES, round(10 * max([*design.bank.lags, design.bank.delays])))
    at, weights = next(design.thinned([len(signals)], design.settings.sample // _EPISODES))
    wanted = np.stack([design.bank.rows(v, at) @ coefficients for v in signals.swapaxes(0, 1)], axis=1)
    most = 2 * design.settings.loss

    def enough(order: int) -> bool:
        missed = (whole.first(order).along(signals)[at] - wanted)[..., used] / errors[used]
        return bool((weights @ np.mean(missed**2, axis=1)).max() <= most * weights.sum())

    # of errors that grow as little as asked, the least order
    bound = next((n for n in (2**i for i in range(len(sigma).bit_length())) if enough(n)), len(sigma))
    return whole.first(bisect_left(range(bound), True, lo=1 + bound // 2, key=enough)).modal()


def observability_root(A: Array, C: Array, delays: int) -> Array:
    """Return L with L' L the observability Gramian: delays end after so many samples, what is slower goes on alone."""
    rows = [C]
    for _ in range(delays):
        rows.append(rows[-1] @ A)
    slow = rows[-1].any(axis=0)
    tail = gramian_root(A[np.ix_(slow, slow)].T, rows[-1][:, slow].T).T
    return qr_triangle(np.vstack([*rows[:-1], tail @ np.eye(len(A))[slow]]))
