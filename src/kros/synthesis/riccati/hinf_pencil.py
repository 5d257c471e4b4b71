r"""Signals of the H-infinity problem on which no controller has an influence: which there are, and which are worst at a level.

Disturbances w that keep ``y = C_y x + D_y w`` at zero leave every controller at rest; of the transposed plant they are output weights that no control
reaches. At a level gamma the worst of them are stationary points of ``gamma^2 |w|^2 - |z|^2``, deflating subspaces of an extended pencil. What they
prove is judged elsewhere (`hinf_dual`), so that nothing rests on the accuracy of this.

References
----------
P. Van Dooren, "A generalized eigenvalue approach for solving Riccati equations", SIAM J. Sci. Stat. Comput. 2 (1981) 121-135.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt
from scipy.linalg import LinAlgError, null_space, ordqz, qr, schur

from ..generalized_plant import GeneralizedPlant

Array = npt.NDArray[Any]

_CUTS = (
    1e-12,
    1e-9,
    1e-6,
    1e-3,
)  # directions of the state below this share are left out; whatever is left proves a bound
_REACHED = 1e-10


@dataclass(frozen=True, eq=False)
class Side:
    """The signals w of ``x+ = A x + B w`` that keep ``C_y x + D_y w`` at zero, and their outputs ``z = C x + D w``."""

    A: Array
    B: Array
    C: Array
    D: Array
    C_y: Array
    D_y: Array
    dt: float

    @classmethod
    def both(cls, p: GeneralizedPlant) -> tuple[Side, Side]:
        """Return the side of the disturbances and that of the outputs, which is the same of the transposed plant."""
        past = cls(p.A, p.B1, p.C1, p.D11, p.C2, p.D21, p.dt)
        return past, cls(p.A.T, p.C1.T, p.B1.T, p.D11.T, p.B2.T, p.D12.T, p.dt)

    def within(self, V: Array) -> Side:
        """Return the side for states ``x = V c``, with orthonormal V."""
        return Side(V.T @ self.A @ V, V.T @ self.B, self.C @ V, self.D, self.C_y @ V, self.D_y, self.dt)

    def reachable(self) -> Array:
        """Orthonormal basis of the states without the stable modes that no signal reaches, which would grow backwards."""
        n, F, N = len(self.A), np.zeros((self.B.shape[1], len(self.A))), np.eye(self.B.shape[1])
        if self.D_y.size:  # w = F x + N v keeps the constraint, for a full-rank D_y
            U, s, Vh = np.linalg.svd(self.D_y)
            r = int(np.sum(s > 1e-12 * s.max(initial=0.0)))
            F, N = -Vh[:r].T @ ((U[:, :r].T @ self.C_y) / s[:r, None]), Vh[r:].T
        A = self.A + self.B @ F
        left = null_space(_reached(A, self.B @ N).T)
        if not left.shape[1]:
            return np.eye(n)
        _, L, k = schur((left.T @ A @ left).T, output="real", sort="iuc" if self.dt > 0 else "lhp")
        return np.asarray(null_space((left @ L[:, :k]).T) if k else np.eye(n))

    def pencil(self, gamma: float) -> tuple[Array, Array, Array]:
        """Extended pencil ``H v = lambda E v`` of the level in (state, costate | w, z / gamma, multiplier of y), and the columns of the latter three."""
        n, m, p, q = len(self.A), self.B.shape[1], len(self.C), len(self.C_y)
        eye, zero = np.eye(n), np.zeros
        outer = np.vstack([np.hstack([self.C, zero((p, n))]), np.hstack([self.C_y, zero((q, n))])])
        to_costate = np.hstack([zero((n, m)), self.C.T, -self.C_y.T])
        stationary = np.hstack([gamma * np.eye(m), -self.D.T, self.D_y.T])
        inner = np.vstack(
            [np.hstack([self.D, -gamma * np.eye(p), zero((p, q))]), np.hstack([self.D_y, zero((q, p + q))])]
        )
        driven = np.hstack([self.B, zero((n, p + q))])
        if self.dt > 0:
            H = np.vstack([np.hstack([self.A, zero((n, n))]), np.hstack([zero((n, n)), eye]), zero((m, 2 * n)), outer])
            E = np.vstack(
                [
                    np.eye(n, 2 * n),
                    np.hstack([zero((n, n)), self.A.T]),
                    np.hstack([zero((m, n)), -self.B.T]),
                    zero((p + q, 2 * n)),
                ]
            )
        else:
            H = np.vstack(
                [
                    np.hstack([self.A, zero((n, n))]),
                    np.hstack([zero((n, n)), -self.A.T]),
                    np.hstack([zero((m, n)), self.B.T]),
                    outer,
                ]
            )
            E = np.vstack([np.eye(2 * n), zero((m + p + q, 2 * n))])
        return H, E, np.vstack([driven, to_costate, stationary, inner])

    def signals(self, gamma: float) -> tuple[Array, list[tuple[Array, Array, Array]]]:
        """Return the eigenvalues, and (V, M, G) for several cuts; none where the signals that decay backwards do not span n directions."""
        n, discrete = len(self.A), self.dt > 0
        H, E, inner = self.pencil(gamma)
        Q = qr(inner)[0][:, inner.shape[1] :].T
        try:
            S, T, alpha, beta, _, Zv = ordqz(Q @ H, Q @ E, sort="ouc" if discrete else "rhp", output="real")
        except (LinAlgError, ValueError):
            return np.zeros(0), []
        with np.errstate(divide="ignore", invalid="ignore"):
            values = np.where(beta != 0, alpha / np.where(beta != 0, beta, 1.0), np.inf)
        outside = np.abs(alpha) > np.abs(beta) if discrete else values.real > 0
        if outside.sum() != n or not outside[:n].all():
            return values, []
        try:
            M = np.linalg.solve(S[:n, :n], T[:n, :n]) if discrete else -np.linalg.solve(T[:n, :n], S[:n, :n])
        except LinAlgError:
            return values, []
        v = Zv[:, :n]
        now, then = (v @ M, v) if discrete else (v, -v @ M)
        G = np.linalg.lstsq(inner, E @ then - H @ now, rcond=None)[0][: self.B.shape[1]]
        if not (np.isfinite(M).all() and np.isfinite(G).all()):
            return values, []
        U, s, Wt = np.linalg.svd(v[:n])
        ranks = {int(np.sum(s > cut * s[0])) for cut in _CUTS} - {0}
        backs = {r: Wt[:r].T / s[:r] for r in sorted(ranks, reverse=True)}
        return values, [(U[:, :r], s[:r, None] * Wt[:r] @ M @ back, G @ back) for r, back in backs.items()]


def _reached(A: Array, B: Array) -> Array:
    """Orthonormal basis of the states that B reaches through A, step by step; directions below the cut do not count."""
    found, new = np.zeros((len(A), 0)), B / max(float(np.linalg.norm(B)), 1e-300)
    size = max(float(np.linalg.norm(A)), 1e-300)
    while new.size and found.shape[1] < len(A):
        new = new - found @ (found.T @ new)
        U, s, _ = np.linalg.svd(new, full_matrices=False)
        new = U[:, s > _REACHED]
        new = np.linalg.qr(new - found @ (found.T @ new))[0]
        found, new = np.hstack([found, new]), A @ new / size
    return found if found.shape[1] else np.zeros((len(A), 1))
