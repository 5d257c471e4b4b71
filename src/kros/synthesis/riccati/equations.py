"""Riccati equations with a check of the residual; the H2 gains built from them.

Symbols
-------
X : stabilising solution of A' X A - X - (A' X B + S)(R + B' X B)^-1 (B' X A + S') + Q = 0 (discrete), or the continuous
    analogue
F : state feedback, u = F x;  F0 : feedforward of the disturbance, u = F x + F0 w (discrete full information)
"""

from __future__ import annotations

import numpy as np
from numpy.linalg import LinAlgError

from ...core.arrays import AnyArray
from ...core.errors import SynthesisError
from ...core.lti import StateSpace
from ...core.rounding import EPS, ITERATED, SINGULAR, TINY
from ..generalized_plant import GeneralizedPlant


def solve_riccati(A: AnyArray, B: AnyArray, Q: AnyArray, R: AnyArray, S: AnyArray, dt: float, method: str) -> AnyArray:
    """Return the stabilising solution X of the algebraic Riccati equation."""
    from scipy.linalg import solve_continuous_are, solve_continuous_lyapunov, solve_discrete_are

    if not A.size:
        return np.zeros((0, 0))
    if dt == 0 and not B.shape[1]:
        return solve_continuous_lyapunov(A.T, -Q)
    if dt > 0:
        X = _doubling(A, B, Q, R, S)
        if X is not None and _residual(A, B, Q, R, S, X) < ITERATED:
            return X
    try:
        X = (solve_discrete_are if dt > 0 else solve_continuous_are)(A, B, Q, R, s=S)
    except (LinAlgError, ValueError) as error:
        problem = f"the Riccati equation of {len(A)} states has no stabilising solution that can be computed ({error})"
        raise SynthesisError(f"{method}: {problem}; check stabilisability, detectability and scaling.") from error
    X = (X + X.T) / 2
    if dt > 0 and (residual := _residual(A, B, Q, R, S, X)) > 1e-5:
        problem = f"the Riccati solution has residual {residual:.2g}"
        raise SynthesisError(f"{method}: {problem}; scale states, inputs and outputs to similar size.")
    return X


def discrete_gain(A: AnyArray, B: AnyArray, R: AnyArray, S: AnyArray, X: AnyArray) -> AnyArray:
    """Optimal discrete feedback ``F = -(R + B' X B)^-1 (B' X A + S')``."""
    return -np.linalg.solve(R + B.T @ X @ B, B.T @ X @ A + S.T)


def _residual(A: AnyArray, B: AnyArray, Q: AnyArray, R: AnyArray, S: AnyArray, X: AnyArray) -> float:
    """Relative residual in the closed-loop (Joseph) form, which does not cancel; infinite for an unstable loop."""
    F = discrete_gain(A, B, R, S, X)
    closed = A + B @ F
    if np.abs(np.linalg.eigvals(closed)).max() >= 1:
        return float("inf")
    cost = Q + S @ F + F.T @ S.T + F.T @ R @ F
    # A plant that can be inverted costs nothing, X = 0: what is left is measured against the terms that cancel.
    size = max(float(np.linalg.norm(X)), float(np.linalg.norm(Q)), TINY)
    return float(np.linalg.norm(closed.T @ X @ closed + cost - X)) / size


def _doubling(A: AnyArray, B: AnyArray, Q: AnyArray, R: AnyArray, S: AnyArray) -> AnyArray | None:
    """Structure-preserving doubling (Chu, Fan, Lin and Wang, 2004): quadratic convergence, sums of semidefinites."""
    try:
        RiS, RiB = np.linalg.solve(R, S.T), np.linalg.solve(R, B.T)
        Ak, G, H = A - B @ RiS, B @ RiB, Q - S @ RiS
        eye = np.eye(len(A))
        for _ in range(60):
            W = np.linalg.solve(eye + G @ H, np.hstack([Ak, G]))
            WA, WG = W[:, : len(A)], W[:, len(A) :]
            step = Ak.T @ H @ WA
            G = G + Ak @ WG @ Ak.T
            H = H + (step + step.T) / 2
            G = (G + G.T) / 2
            Ak = Ak @ WA
            if not np.isfinite(H).all():
                return None
            if np.linalg.norm(step) <= EPS * np.linalg.norm(H):
                return H
    except np.linalg.LinAlgError:
        return None
    return None


def riccati_pair(p: GeneralizedPlant, method: str) -> tuple[AnyArray, AnyArray]:
    """Return the solutions of the control and filter Riccati equations of a plant's H2 problem."""
    X = solve_riccati(p.A, p.B2, p.C1.T @ p.C1, p.D12.T @ p.D12, p.C1.T @ p.D12, p.dt, f"{method}, control")
    Y = solve_riccati(p.A.T, p.C2.T, p.B1 @ p.B1.T, p.D21 @ p.D21.T, p.B1 @ p.D21.T, p.dt, f"{method}, filter")
    return X, Y


def absorb_feedthrough(K: StateSpace, D22: AnyArray) -> StateSpace:
    """Turn a controller for ``y - D22 u`` into one for ``y``."""
    if not np.any(D22):
        return K
    loop = np.eye(K.n_outputs) + K.D @ D22
    if np.linalg.cond(loop) > SINGULAR:
        raise SynthesisError("Algebraic loop: I + D^c D22 is singular; add a delay to the plant, or change D22.")
    C, D = np.linalg.solve(loop, K.C), np.linalg.solve(loop, K.D)
    return StateSpace(K.A - K.B @ D22 @ C, K.B - K.B @ D22 @ D, C, D, K.dt)


def balancing(R: AnyArray, S: AnyArray, negligible: float = 0.0) -> tuple[AnyArray, AnyArray, AnyArray]:
    """Balance the Gramians ``R R'`` and ``S S'``: left, right, ``left @ right = I``, and the Hankel singular values.

    The balanced state is ``left x``. Values below a share of the largest are `negligible`.
    """
    U, values, Vh = np.linalg.svd(S.T @ R, full_matrices=False)
    k = int(np.sum(values > negligible * values.max(initial=0.0)))
    root = np.sqrt(values[:k])
    return (U[:, :k] / root).T @ S.T, R @ Vh[:k].T / root, values[:k]
