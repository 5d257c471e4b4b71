r"""Lower bounds of the H-infinity problem from signals on which no controller has an influence.

    t < 0:  w = w_p with y = 0 and u = 0, so that every controller is at rest and the state reaches x0
    t >= 0: outputs weighted by zeta, orthogonal to whatever u does, which see x0 as p0' x0

With ``z_p`` the outputs of the past and ``g`` the adjoint's response to zeta (both are the same for every controller),

.. math:: \|T\|^2 \ge \gamma^2 \quad\text{where}\quad
    \gamma^2 \|w_p\|^2 - \|z_p\|^2 + \|\zeta\|^2 - \|g\|^2 / \gamma^2 \le 2\, p_0^T x_0

The signals come from the Hamiltonian pencil of a level, but they prove the bound whatever they come from: constraints and energies are evaluated again
in the coordinates of the plant, and errors of the gains enter squared. No decision rests on an eigenvalue being on the stability boundary.

Symbols
-------
x = V c : states of the past (or, for the transposed plant, the adjoint states of the future), shape (n, r)
M, G : ``c(k) = M c(k+1)``, ``w(k) = G c(k+1)``; in continuous time ``dc/dtau = M c``, ``w = G c`` with tau = -t
W, Z : energies of w and z as quadratic forms of c(0)

References
----------
K. Zhou, J. C. Doyle, K. Glover, *Robust and Optimal Control*, section 16.8 (the mixed Hankel-Toeplitz operator); P. Gahinet, P. Apkarian,
"A linear matrix inequality approach to H-infinity control", Int. J. Robust and Nonlinear Control 4 (1994) 421-448.
"""

from __future__ import annotations

import warnings
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import numpy.typing as npt
from scipy.linalg import LinAlgError, solve_continuous_lyapunov

from ...core.norms import gramian
from .hinf_pencil import Side

Array = npt.NDArray[Any]

_EPS = float(np.finfo(float).eps)
_CONSTRAINTS = 100 * _EPS


@dataclass(frozen=True, eq=False)
class Signals:
    """A family of signals of one side: energies W and Z, and bounds `of_w`, `of_z` of their rounding errors, all as quadratic forms of c(0)."""

    V: Array
    W: Array
    Z: Array
    of_w: Array
    of_z: Array

    @classmethod
    def none(cls, n: int) -> Signals:
        """Return the family that holds nothing but zero."""
        return cls(np.zeros((n, 0)), *(np.zeros((0, 0)) for _ in range(4)))


def evaluated(s: Side, V: Array, M: Array, G: Array) -> Signals | None:
    """Make the signals satisfy the constraints, and return their energies; None where that fails beyond rounding, or they do not decay."""
    r = V.shape[1]
    if s.dt > 0:
        J = np.block([[s.A @ V, s.B], [s.C_y @ V, s.D_y]])
        target = np.vstack([V, np.zeros((len(s.C_y), r))])
    else:
        J = np.block([[V, s.B], [np.zeros((len(s.C_y), r)), s.D_y]])
        target = -np.vstack([s.A @ V, s.C_y @ V])
    found = np.vstack([M, G])
    rows = np.linalg.norm(np.block([[s.A, s.B], [s.C_y, s.D_y]]), axis=1)[:, None]
    size = np.where(rows > 0, rows, 1.0)
    for _ in range(2):
        found = found + np.linalg.lstsq(J / size, (target - J @ found) / size, rcond=None)[0]
    if not np.isfinite(found).all():
        return None
    # What is left is that of a plant whose rows differ by rounding.
    columns = np.linalg.norm(np.vstack([V @ found[:r] if s.dt > 0 else V, found[r:]]), axis=0)
    moved = np.vstack([np.abs(V) if s.dt > 0 else np.abs(V) @ np.abs(found[:r]), np.zeros((len(s.C_y), r))])
    if np.any(np.abs(target - J @ found) > _CONSTRAINTS * len(J) * (rows * columns + moved)):
        return None
    M, G = found[:r], found[r:]
    out = s.C @ V @ M + s.D @ G if s.dt > 0 else s.C @ V + s.D @ G
    energies = _energies(M, G, out, s.dt)
    if energies is None:
        return None
    # Again in units in which the energies are about one, so that errors are small beside all of them.
    W, Z = energies.W, energies.Z
    values, vectors = np.linalg.eigh(W + Z / max(np.trace(Z) / max(np.trace(W), 1e-300), 1e-300))
    root = np.sqrt(np.maximum(values, 1e-14 * values[-1]))
    unit, back = vectors / root, (vectors * root).T
    energies = _energies(back @ M @ unit, G @ unit, out @ unit, s.dt)
    return None if energies is None else replace(energies, V=V @ unit)


def _energies(M: Array, G: Array, out: Array, dt: float) -> Signals | None:
    """Gramians with the bound of their errors: a residual R changes a Gramian by at most ``||R||`` times that of the identity."""
    eye = np.eye(len(M))
    try:
        if (np.abs(np.linalg.eigvals(M)).max() >= 1) if dt > 0 else (np.linalg.eigvals(M).real.max() >= 0):
            return None
        with warnings.catch_warnings():
            warnings.simplefilter(
                "error", RuntimeWarning
            )  # overflow, or a Lyapunov equation that was perturbed to be solved
            unit, W, Z = (_gramian(M, F, dt) for F in (eye, G, out))
    except (LinAlgError, ValueError, RuntimeWarning):
        return None
    if not all(np.isfinite(X).all() for X in (unit, W, Z)) or np.linalg.eigvalsh(unit)[0] <= 0:
        return None
    # A positive definite Gramian of the identity with a residual below one half proves that the signals decay.
    if _residual(M, eye, unit, dt) >= 0.5:
        return None
    return Signals(eye, W, Z, 2 * _residual(M, G, W, dt) * unit, 2 * _residual(M, out, Z, dt) * unit)


def _gramian(M: Array, F: Array, dt: float) -> Array:
    found = gramian(M.T, F.T, dt) if dt > 0 else solve_continuous_lyapunov(M.T, -F.T @ F)
    return np.asarray((found + found.T) / 2)


def _residual(M: Array, F: Array, X: Array, dt: float) -> float:
    rest = M.T @ X @ M + F.T @ F - X if dt > 0 else M.T @ X + X @ M + F.T @ F
    power = np.linalg.norm(M) ** 2 + 1 if dt > 0 else 2 * np.linalg.norm(M)
    return float(np.linalg.norm(rest) + 4 * len(M) * _EPS * (power * np.linalg.norm(X) + np.linalg.norm(F) ** 2))


def coupled(past: Signals, future: Signals) -> float:
    """Return the largest norm that signals of the two families prove, less its rounding."""
    r = past.V.shape[1]
    if not r + future.V.shape[1]:
        return 0.0
    cross = np.zeros((r + future.V.shape[1],) * 2)
    cross[:r, r:] = past.V.T @ future.V
    cross[r:, :r] = cross[:r, r:].T
    rounding = 10 * len(past.V) * _EPS * np.abs(past.V).T @ np.abs(future.V)
    W, Z = _diagonal(past.W + past.of_w, future.W + future.of_w), _diagonal(past.Z - past.of_z, future.Z - future.of_z)
    best = 0.0
    try:
        values, vectors = np.linalg.eigh(W)
        if values[0] <= 0:
            return 0.0
        root = vectors / np.sqrt(values)
        for _ in range(30):
            # The signals that are worst at the level that is proven prove a higher one (a Rayleigh quotient).
            form = cross + Z / best if best > 0 else cross if cross.any() else Z
            c = root @ np.linalg.eigh(root.T @ form @ root)[1][:, -1]
            c *= np.sign(c @ cross @ c) or 1.0
            inner = c @ cross @ c / 2 - np.abs(c[:r]) @ rounding @ np.abs(c[r:])
            w, z = float(c @ W @ c), float(c @ Z @ c)
            value = _root(w, max(inner, 0.0), z)
            if value <= best * (1 + 1e-13):
                break
            best = value
    except LinAlgError:
        return best
    return float(best)


def _root(w: float, inner: float, z: float) -> float:
    """Level at which ``w gamma - z / gamma = 2 inner``."""
    return (inner + float(np.sqrt(max(inner**2 + w * z, 0.0)))) / w


def _diagonal(a: Array, b: Array) -> Array:
    """Block diagonal matrix."""
    return np.block([[a, np.zeros((len(a), len(b)))], [np.zeros((len(b), len(a))), b]])
