r"""One level of the H-infinity problem: is it attainable, and by which central controller (continuous time, all feedthroughs).

The plant is normalised first, ``D12 = [0; I]`` and ``D21 = [0, I]``. A controller with ``||T|| < gamma`` exists exactly when the direct gain
leaves room (Parrott), both Riccati equations have stabilising solutions, these are positive semidefinite, and ``rho(X Y) < gamma^2``.

Symbols
-------
H, J : Hamiltonian matrices of control and filter, (2n, 2n);  X, Y : their stabilising solutions, (n, n)
F = [F11; F12; F2] : state feedback, rows of the free disturbances, the measured ones, the control
L = [L11, L12, L2] : output injection, columns of the free outputs, the penalised ones, the measurements
E = I - Y X / gamma^2 : coupling; its inverse is Z of the source, and is never formed

References
----------
K. Zhou, J. C. Doyle, K. Glover, *Robust and Optimal Control*, theorem 17.1 (page 442); K. Glover and J. C. Doyle, "State-space formulae for all
stabilizing controllers that satisfy an H-infinity-norm bound", Systems & Control Letters 11 (1988) 167-172.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt
from scipy.linalg import LinAlgError, schur

from ...core.lti import StateSpace
from ..generalized_plant import GeneralizedPlant
from .hinf_pointwise import direct_bound

Array = npt.NDArray[Any]

_AXIS = 1e-14
_ROUNDING = 1e-12
_NEGATIVE = 1e-7
_ASYMMETRY = 1e-5


@dataclass(frozen=True, eq=False)
class Normalised:
    """A continuous plant with ``D12 = [0; I]``, ``D21 = [0, I]``, ``D22 = 0``; its controller K belongs to ``left K right`` of the original."""

    plant: GeneralizedPlant
    left: Array
    right: Array


def normalise(p: GeneralizedPlant) -> Normalised:
    """Rotate w and z and scale u and y, so that ``D12 = [0; I]`` and ``D21 = [0, I]``; norms from w to z stay. D22 is dropped."""
    n_u, n_y = p.sizes[2], p.sizes[4]
    U, s, Vh = np.linalg.svd(p.D12)
    outputs, left = np.roll(U, -n_u, axis=1).T, Vh.T / s
    V, t, Wh = np.linalg.svd(p.D21)
    inputs, right = np.roll(Wh, -n_y, axis=0).T, V.T / t[:, None]
    _, n_w, _, n_z, _ = p.sizes
    return Normalised(
        GeneralizedPlant(
            p.A,
            p.B1 @ inputs,
            p.B2 @ left,
            outputs @ p.C1,
            right @ p.C2,
            outputs @ p.D11 @ inputs,
            np.eye(n_z)[:, n_z - n_u :],
            np.eye(n_w)[n_w - n_y :],
            np.zeros((n_y, n_u)),
            0.0,
        ),
        left,
        right,
    )


def central(p: GeneralizedPlant, gamma: float) -> StateSpace | None:
    """Return the central controller of a normalised plant for the level `gamma`; None proves nothing, `hinf_bound` does."""
    if gamma <= direct_bound(p):
        return None
    n, n_w, _, n_z, _ = p.sizes
    B, C = np.hstack([p.B1, p.B2]), np.vstack([p.C1, p.C2])
    row, column = np.hstack([p.D11, p.D12]), np.vstack([p.D11, p.D21])
    R = row.T @ row
    R[:n_w, :n_w] -= gamma**2 * np.eye(n_w)
    S = column @ column.T
    S[:n_z, :n_z] -= gamma**2 * np.eye(n_z)
    try:
        X = _stabilising(p.A, B, p.C1, row, R)
        Y = _stabilising(p.A.T, C.T, p.B1.T, column.T, S)
        if X is None or Y is None:
            return None
        coupling = Y @ X / gamma**2
        if np.abs(np.linalg.eigvals(coupling)).max(initial=0.0) >= 1:
            return None
        F = -np.linalg.solve(R, row.T @ p.C1 + B.T @ X)
        L = -np.linalg.solve(S, column @ p.B1.T + C @ Y).T
        return _assemble(p, gamma, F, L, np.eye(n) - coupling)
    except (LinAlgError, ValueError):
        return None


def _assemble(p: GeneralizedPlant, gamma: float, F: Array, L: Array, E: Array) -> StateSpace:
    """Central controller (Zhou, Doyle and Glover, theorem 17.1)."""
    _, n_w, n_u, n_z, n_y = p.sizes
    free_z, free_w = n_z - n_u, n_w - n_y
    D1111, D1112 = p.D11[:free_z, :free_w], p.D11[:free_z, free_w:]
    D1121, D1122 = p.D11[free_z:, :free_w], p.D11[free_z:, free_w:]
    D = -D1121 @ D1111.T @ np.linalg.solve(gamma**2 * np.eye(free_z) - D1111 @ D1111.T, D1112) - D1122
    innovation = p.C2 + F[free_w:n_w]
    scaled = (p.B2 + L[:, free_z:n_z]) @ D - L[:, n_z:]
    solved = np.linalg.solve(E, scaled)
    A = p.A + p.B1 @ F[:n_w] + p.B2 @ F[n_w:] - solved @ innovation
    return StateSpace(A, solved, F[n_w:] - D @ innovation, D, 0.0)


def _stabilising(A: Array, B: Array, C: Array, D: Array, R: Array) -> Array | None:
    """Stabilising X of the indefinite Riccati equation; None when there is none that is semidefinite, or in doubt."""
    n = len(A)
    if not n:
        return np.zeros((0, 0))
    gain = np.linalg.solve(R, np.hstack([D.T @ C, B.T]))
    closed = A - B @ gain[:, :n]
    quadratic, cost = B @ gain[:, n:], C.T @ C - C.T @ D @ gain[:, :n]
    # A change of the units of X levels the blocks: rounding is then relative to both, and slow modes are not lost beside fast ones.
    sizes = [float(np.linalg.norm(x)) for x in (closed, quadratic, cost)]
    unit = np.sqrt(sizes[2] / sizes[1]) if sizes[1] * sizes[2] > (_ROUNDING * sizes[0]) ** 2 else 1.0
    H = np.block([[closed, -unit * (quadratic + quadratic.T) / 2], [-(cost + cost.T) / (2 * unit), -closed.T]])
    T, Z, stable = schur(H, output="real", sort="lhp")
    # LAPACK's real Schur form has the real parts of all eigenvalues on its diagonal.
    if stable != n or np.abs(np.diag(T)).min() <= _AXIS * np.linalg.norm(H):
        return None
    X1, X2 = Z[:n, :n], Z[n:, :n]
    product = X1.T @ X2
    if np.abs(product - product.T).max() > _ASYMMETRY * max(np.abs(product).max(), 1e-3):
        return None
    X: Array = np.linalg.solve(X1.T, X2.T).T
    X = unit * (X + X.T) / 2
    values = np.linalg.eigvalsh(X)
    return None if values[0] < -_NEGATIVE * max(values[-1], -values[0], 1e-300) and values[0] < -1e-10 else X
