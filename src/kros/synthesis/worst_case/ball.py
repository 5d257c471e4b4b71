r"""The uncertain set per frequency: a matrix ball, its bound and its average.

With ``N = W_R W_L``, ``||N|| < 1`` and ``X = Delta (I - N Delta)^-1``, completing the square in ``||Delta|| <= 1``
gives

    { X : ||Delta|| <= 1 } = { X_c + R_l Theta R_r : ||Theta|| <= 1 },
    X_c = N^H (I - N N^H)^-1,   R_l = (I - N^H N)^(-1/2),   R_r = (I - N N^H)^(-1/2).

Without a loop (``N = 0``) it is the unit ball itself; the same formulas hold whatever N is made of.

*Upper bound* of ``||a + P Theta Q||_F``, a Lagrangian dual. With ``P = U diag(s) V^H``, ``Q = G diag(q) H^H``, ``d_ij =
s_i^2 q_j^2`` and ``c_ij = s_i q_j (U^H a H)_ij``, the rows and columns of a contraction have norms of at most one.
Giving them multipliers g_i, l_j >= 0 with ``g_i + l_j >= d_ij`` and completing the square,

    ||a + P Theta Q||_F^2 <= ||a||_F^2 + sum_i g_i + sum_j l_j + sum_ij |c_ij|^2 / (g_i + l_j - d_ij).

*Any* feasible multipliers give a valid bound; coordinate descent makes it good. For ``a = 0`` it is ``sum s_i^2 q_i^2``
(von Neumann's trace inequality), for scalars ``(|a| + s q)^2``: both exact.

*Average.* Theta uniform on the matrices (b, a) with orthonormal columns or rows has mean zero and ``E[Theta Q Q^H
Theta^H] = I ||Q||_F^2 / max(a, b)`` (`Ball.average`).
"""

from __future__ import annotations

import numpy as np
from numpy.linalg import svd

from ...core import EPS, TINY, AnyArray, frozen
from ...core.linalg import adjoint, energy, entries_first
from ..problem.observer_problem import ObserverProblem

_SMALL = float(np.sqrt(TINY))  # what is divided by it and squared stays finite


@frozen
class Ball:
    """The set ``{X_c + R_l Theta R_r}`` over frequency, with the right factor M already multiplied in."""

    center: AnyArray  # shape (f, b, m); ``X_c M``
    left: AnyArray  # shape (f, b, b); ``R_l``
    right: AnyArray  # shape (f, a, m); ``R_r M``

    @classmethod
    def of(cls, N: AnyArray, M: AnyArray) -> Ball:
        """Build the ball of ``Delta (I - N Delta)^-1 M`` from N (f, a, b) and M (f, a, m)."""
        U, s, Vh = svd(N)
        k = s.shape[-1]
        radius = 1 / np.sqrt(1 - s**2)
        X_c = (adjoint(Vh)[..., :k] * (s * radius**2)[..., None, :]) @ adjoint(U)[..., :k, :]
        return cls(X_c @ M, _with_gains(adjoint(Vh), radius), _with_gains(U, radius) @ M)

    def bound(self, T: AnyArray, certain: AnyArray | float = 0.0) -> AnyArray:
        """Root of the H2 density of ``certain + T X M`` that no member exceeds, (f,); `certain` is (f, p, m)."""
        return dual_bound(certain + T @ self.center, T @ self.left, self.right)

    def average(self) -> AnyArray:
        """Average spectrum, shape (f, b, b)."""
        share = energy(self.right) / max(self.right.shape[-2], self.left.shape[-1])
        return self.center @ adjoint(self.center) + share[..., None, None] * (self.left @ adjoint(self.left))


def uncertain_ball(problem: ObserverProblem, freqs_hz: AnyArray) -> Ball:
    """Return the ball of ``Delta (I - N Delta)^-1 M`` of a problem at frequencies."""
    return Ball.of(problem.N.frequency_response(freqs_hz), problem.M.frequency_response(freqs_hz))


def _with_gains(U: AnyArray, gains: AnyArray) -> AnyArray:
    """Return ``U diag(gains, 1, ...) U^H``."""
    gains = np.concatenate([gains, np.ones((*gains.shape[:-1], U.shape[-1] - gains.shape[-1]))], axis=-1)
    return (U * gains[..., None, :]) @ adjoint(U)


def dual_bound(a: AnyArray, P: AnyArray, Q: AnyArray) -> AnyArray:
    """Upper bound of ``max ||a + P Theta Q||_F`` over contractions, shape (f,)."""
    U, s, _ = svd(P, full_matrices=False)
    _, q, Hh = svd(Q, full_matrices=False)
    d = (s[..., :, None] * q[..., None, :]) ** 2
    rotated = adjoint(U) @ a @ adjoint(Hh)
    c = d * np.abs(rotated) ** 2
    g, multipliers = _without_centre(s, q)
    g = g + np.sqrt(c.sum(axis=(-2, -1)) / max(s.shape[-1], 1))[..., None]
    g, multipliers = _descended(c, d, g, multipliers)
    rounding = 4 * EPS
    g = g + rounding * (g + d.max(axis=-1, initial=0.0))  # else the slack of a tiny centre is rounded to zero
    slack = g[..., :, None] + multipliers[..., None, :] - d
    rest = np.where(c > 0, c / np.maximum(slack, _SMALL), 0.0).sum(axis=(-2, -1))
    squared = energy(a) + g.sum(axis=-1) + multipliers.sum(axis=-1) + rest
    return np.where(np.isfinite(squared), np.sqrt(squared), np.inf)


def _without_centre(s: AnyArray, q: AnyArray) -> tuple[AnyArray, AnyArray]:
    """Optimal multipliers for ``a = 0``: the dual of the sorted assignment (s and q descend)."""
    rows, columns = s.shape[-1], q.shape[-1]
    size = max(rows, columns)
    s, q = (np.pad(x, ((0, 0), (0, size - x.shape[-1]))) for x in (s, q))
    steps = -np.diff(s**2, append=0.0) * q**2
    g = np.cumsum(steps[..., ::-1], axis=-1)[..., ::-1]
    return g[..., :rows], np.maximum(s**2 * q**2 - g, 0.0)[..., :columns]


def _descended(c: AnyArray, d: AnyArray, g: AnyArray, multipliers: AnyArray) -> tuple[AnyArray, AnyArray]:
    """Return better multipliers of rows and columns, by turns; sums run with frequencies last."""
    c, d, rows, columns = entries_first(c), entries_first(d), g.T, multipliers.T
    for _ in range(10):  # sweeps
        rows = _best_rows(c, columns - d)
        columns = _best_rows(c.swapaxes(0, 1), rows - d.swapaxes(0, 1))
    return rows.T, columns.T


def _best_rows(c: AnyArray, shift: AnyArray) -> AnyArray:
    """Minimise ``x + sum_j c_ij / (x + shift_ij)`` over ``x >= 0``, ``x + shift_ij >= 0``, for every row i."""
    least = np.maximum(np.max(-shift, axis=1), 0.0)
    gap = least[:, None] + shift
    x = np.maximum(np.max(np.sqrt(c) - gap, axis=1), 0.0)
    for _ in range(4):  # steps
        inverse = 1 / np.maximum(x[:, None] + gap, _SMALL)
        terms = c * inverse * inverse
        h = np.maximum(terms.sum(axis=1), TINY)
        slope = np.maximum((terms * inverse).sum(axis=1), TINY)
        x = np.maximum(x + (h * np.sqrt(h) - h) / slope, 0.0)
    return least + x
