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

_CUTS = (1e-12, 1e-9, 1e-6, 1e-3)  # directions of the state below this share are left out; whatever is left proves a bound
_REACHED = (1e-7, 1e-10, 1e-13)


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

    def kept_zero(self) -> tuple[Array, Array]:
        """Return (F, N) with ``w = F x + N v``: the signals that keep the constraint, for a full-rank D_y."""
        if not self.D_y.size:
            return np.zeros((self.B.shape[1], len(self.A))), np.eye(self.B.shape[1])
        U, s, Vh = np.linalg.svd(self.D_y)
        r = int(np.sum(s > 1e-12 * s.max(initial=0.0)))
        return -Vh[:r].T @ ((U[:, :r].T @ self.C_y) / s[:r, None]), Vh[r:].T

    def within(self, V: Array) -> Side:
        """Return the side for states ``x = V c``, with orthonormal V."""
        return Side(V.T @ self.A @ V, V.T @ self.B, self.C @ V, self.D, self.C_y @ V, self.D_y, self.dt)

    def reachable(self) -> list[Array]:
        """Orthonormal bases of the states without the stable modes that no signal reaches, for several ideas of what is not reached.

        Such modes would grow backwards. The whole space is the last idea, unless nothing is reached at all.
        """
        n = len(self.A)
        F, N = self.kept_zero()
        A, B = self.A + self.B @ F, self.B @ N
        bases: dict[int, Array] = {}
        for cut in _REACHED:
            left, k = null_space(_reached(A, B, cut).T), 0
            if left.shape[1]:
                _, L, k = schur((left.T @ A @ left).T, output="real", sort="iuc" if self.dt > 0 else "lhp")
            V = null_space((left @ L[:, :k]).T) if k else np.eye(n)
            bases.setdefault(V.shape[1], V)
        if 0 not in bases:
            bases[n] = np.eye(n)
        return [bases[r] for r in sorted(bases) if r]


@dataclass(frozen=True, eq=False)
class Pencil:
    """``H v = lambda E v`` of the stationary signals of one side at a level, after elimination of (w, z, multiplier)."""

    side: Side
    H: Array
    E: Array
    inner: Array
    H_inner: Array
    E_inner: Array

    @classmethod
    def of(cls, s: Side, gamma: float) -> Pencil:
        """Extended pencil in (state, costate | w, z / gamma, multiplier of y): nothing is inverted or squared."""
        n, m, p, q = len(s.A), s.B.shape[1], len(s.C), len(s.C_y)
        eye, zero = np.eye(n), np.zeros
        outer = np.vstack([np.hstack([s.C, zero((p, n))]), np.hstack([s.C_y, zero((q, n))])])
        to_costate = np.hstack([zero((n, m)), s.C.T, -s.C_y.T])
        stationary = np.hstack([gamma * np.eye(m), -s.D.T, s.D_y.T])
        inner = np.vstack([np.hstack([s.D, -gamma * np.eye(p), zero((p, q))]), np.hstack([s.D_y, zero((q, p + q))])])
        driven = np.hstack([s.B, zero((n, p + q))])
        if s.dt > 0:
            H = np.vstack([np.hstack([s.A, zero((n, n))]), np.hstack([zero((n, n)), eye]), zero((m, 2 * n)), outer])
            E = np.vstack([np.eye(n, 2 * n), np.hstack([zero((n, n)), s.A.T]), np.hstack([zero((m, n)), -s.B.T]), zero((p + q, 2 * n))])
        else:
            H = np.vstack([np.hstack([s.A, zero((n, n))]), np.hstack([zero((n, n)), -s.A.T]), np.hstack([zero((m, n)), s.B.T]), outer])
            E = np.vstack([np.eye(2 * n), zero((m + p + q, 2 * n))])
        whole = np.vstack([driven, to_costate, stationary, inner])
        Q = qr(whole)[0][:, m + p + q :].T
        return cls(s, Q @ H, Q @ E, whole, H, E)

    def signals(self) -> tuple[Array, list[tuple[Array, Array, Array]]]:
        """Return the eigenvalues, and (V, M, G) for several cuts; none where the signals that decay backwards do not span n directions."""
        n = len(self.side.A)
        discrete = self.side.dt > 0
        try:
            S, T, alpha, beta, _, Zv = ordqz(self.H, self.E, sort="ouc" if discrete else "rhp", output="real")
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
        G = np.linalg.lstsq(self.inner, self.E_inner @ then - self.H_inner @ now, rcond=None)[0][: self.side.B.shape[1]]
        U, s, Wt = np.linalg.svd(v[:n])
        found, ranks = [], {int(np.sum(s > cut * s[0])) for cut in _CUTS}
        for r in sorted(ranks, reverse=True):
            if r and np.isfinite(M).all() and np.isfinite(G).all():
                back = Wt[:r].T / s[:r]
                found.append((U[:, :r], s[:r, None] * Wt[:r] @ M @ back, G @ back))
        return values, found


def _reached(A: Array, B: Array, cut: float) -> Array:
    """Orthonormal basis of the states that B reaches through A, step by step; directions below the cut do not count."""
    found, new = np.zeros((len(A), 0)), B / max(float(np.linalg.norm(B)), 1e-300)
    size = max(float(np.linalg.norm(A)), 1e-300)
    while new.size and found.shape[1] < len(A):
        new = new - found @ (found.T @ new)
        U, s, _ = np.linalg.svd(new, full_matrices=False)
        new = U[:, s > cut]
        new = np.linalg.qr(new - found @ (found.T @ new))[0]
        found, new = np.hstack([found, new]), A @ new / size
    return found if found.shape[1] else np.zeros((len(A), 1))
