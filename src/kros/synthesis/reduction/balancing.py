r"""Balancing by square roots: Gramians are never formed, so states that matter little keep their digits.

Discrete time. ``P = sum_k A^k B B' A'^k`` is summed by doubling, ``P_2k = P_k + A^k P_k A'^k``, on its factor: ``P = R R'`` and ``R_2k`` is the
triangle of ``[R_k, A^k R_k]``. Poles near one cost a few more doublings and no accuracy.

Symbols
-------
P = R R' : controllability Gramian;  Q = S S' : observability Gramian;  S' R = U diag(h) V' with h the Hankel singular values
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from ...core.linalg import qr_triangle
from ...core.lti import StateSpace
from ...core.norms import gramian

Array = npt.NDArray[Any]

_DOUBLINGS = 60
_NEGLIGIBLE = 1e-12


def gramian_root(A: Array, B: Array, dt: float) -> Array:
    """Return R with ``R R'`` the controllability Gramian of a stable pair, shape (n, at most n) in discrete time."""
    if dt == 0:
        values, vectors = np.linalg.eigh(gramian(A, B, dt))
        return np.asarray(vectors * np.sqrt(np.maximum(values, 0.0)))
    power, R = A, qr_triangle(B.T).T
    for _ in range(_DOUBLINGS):
        step = power @ R
        R = qr_triangle(np.hstack([R, step]).T).T
        if np.abs(step).max(initial=0.0) <= 1e-9 * np.abs(R).max(initial=0.0):
            break
        power = power @ power
    return R


@dataclass(frozen=True, eq=False)
class Balancing:
    """Balanced coordinates of a system or of a part of one."""

    left: Array  # shape (k, n); Balanced state = left @ state
    right: Array  # shape (n, k); ``left @ right`` is the identity
    values: Array  # shape (k,); Hankel singular values, descending; negligible ones are left out

    @classmethod
    def of(cls, R: Array, S: Array) -> Balancing:
        """Balance the Gramians ``R R'`` and ``S S'``, factors of shape (n, any)."""
        U, h, Vh = np.linalg.svd(S.T @ R, full_matrices=False)
        k = int(np.sum(h > _NEGLIGIBLE * h.max(initial=0.0)))
        root = np.sqrt(h[:k])
        return cls((U[:, :k] / root).T @ S.T, R @ Vh[:k].T / root, h[:k])

    def truncated(self, system: StateSpace, order: int) -> StateSpace:
        """Keep the first `order` balanced states and drop the others."""
        left, right = self.left[:order], self.right[:, :order]
        return StateSpace(left @ system.A @ right, left @ system.B, system.C @ right, system.D, system.dt)

    def residualised(self, system: StateSpace, order: int) -> StateSpace:
        """Keep the first `order` balanced states and let the others follow at once, which keeps the gain at zero frequency."""
        full = self.truncated(system, len(self.values))
        k, size = order, len(self.values)
        still = np.eye(size - k) if system.dt > 0 else np.zeros((size - k, size - k))
        follow = np.linalg.solve(still - full.A[k:, k:], np.hstack([full.A[k:, :k], full.B[k:]]))
        return StateSpace(
            full.A[:k, :k] + full.A[:k, k:] @ follow[:, :k],
            full.B[:k] + full.A[:k, k:] @ follow[:, k:],
            full.C[:, :k] + full.C[:, k:] @ follow[:, :k],
            full.D + full.C[:, k:] @ follow[:, k:],
            system.dt,
        )
