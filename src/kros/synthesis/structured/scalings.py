r"""Upper bound of the structured singular value by scalings, at all frequencies at once.

.. math:: \mu(M) \le \inf_X \sqrt{\lambda}, \qquad M^H X_L M \preceq \lambda X_R, \quad 0 \prec X \prec I

with ``X_R Delta = Delta X_L`` for every Delta of the structure. The problem is quasi-convex and, where singular values meet at the optimum, not
smooth, so it is solved by the method of centres: the analytic centre of ``{X : lambda X_R > M^H X_L M, 0 < X < I}`` is found by Newton steps, then
lambda is lowered towards what the centre attains. The centre also is the best conditioned and smoothest over frequency of all
scalings that do. The start is Osborne's balancing of the norms of the blocks. Every scaling gives a valid bound: the value
returned is the largest singular value after scaling, recomputed.

References
----------
S. Boyd and L. El Ghaoui, "Method of centers for minimizing generalized eigenvalues", Linear Algebra and its Applications 188-189 (1993) 63-111.
E. E. Osborne, "On pre-conditioning of matrices", Journal of the ACM 7 (1960) 338-345.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from ...core.linalg import adjoint
from .blocks import Structure

Array = npt.NDArray[Any]

_SWEEPS = 20
_ROUNDS = 40
_NEWTON = 40
_STEP = 0.1  # lambda comes this close to what the centre attains
_CLOSE = 1e-7
_RIDGE = 1e-13


@dataclass(frozen=True, eq=False)
class Scalings:
    """Upper bound and the scalings that attain it, over frequency.

    Parameters
    ----------
    upper : ndarray, shape (f,)
    X_L : ndarray, shape (f, z, z)
    X_R : ndarray, shape (f, w, w)
    """

    upper: Array
    X_L: Array
    X_R: Array


def scalings(M: Array, structure: Structure, diagonal: bool = False) -> Scalings:
    """Return the best scalings of matrices M, shape (f, z, w)."""
    scale = np.maximum(np.linalg.norm(M, axis=(-2, -1)), 1e-300)[:, None, None]
    M = M / scale
    E_L, E_R = structure.basis(diagonal)
    start_L, start_R = _osborne(M, structure)
    M = start_L[:, :, None] * M / start_R[:, None, :]
    x = np.zeros((len(M), len(E_L)))
    x[:, np.abs(np.trace(E_L, axis1=1, axis2=2)) > 0] = 0.5
    best = _attained(M, x, E_L, E_R)
    best_x, level = x.copy(), best * 1.2 + 1e-30
    active = np.arange(len(M))
    for _ in range(_ROUNDS):
        x[active] = _centre(M[active], x[active], level[active], E_L, E_R)
        value = _attained(M[active], x[active], E_L, E_R)
        better = value < best[active]
        gained = (level[active] - value) > _CLOSE * level[active]
        best[active] = np.where(better, value, best[active])
        best_x[active] = np.where(better[:, None], x[active], best_x[active])
        level[active] = value + _STEP * (level[active] - value)
        active = active[gained]
        if not active.size or E_L.shape[0] == 1:
            break
    X_L = start_L[:, :, None] * np.tensordot(best_x, E_L, 1) * start_L[:, None, :]
    X_R = start_R[:, :, None] * np.tensordot(best_x, E_R, 1) * start_R[:, None, :]
    return Scalings(np.sqrt(np.maximum(best, 0.0)) * scale[:, 0, 0], X_L, X_R)


def _attained(M: Array, x: Array, E_L: Array, E_R: Array) -> Array:
    """Largest squared singular value after scaling, shape (f,)."""
    X_L, X_R = np.tensordot(x, E_L, 1), np.tensordot(x, E_R, 1)
    right = adjoint(np.linalg.inv(np.linalg.cholesky(X_R)))
    scaled = adjoint(np.linalg.cholesky(X_L)) @ M @ right
    return np.asarray(np.linalg.norm(scaled, 2, axis=(-2, -1)) ** 2)


def _osborne(M: Array, structure: Structure) -> tuple[Array, Array]:
    """Scalings of the signals of z, shape (f, z), and of w that balance the norms of the blocks, the largest of them one."""
    seen, driven = structure.seen(), structure.driven()
    n = len(seen)
    squared = np.array([[np.sum(np.abs(M[:, r, c]) ** 2, axis=(-2, -1)) for c in driven] for r in seen]).transpose(2, 0, 1)
    squared = (squared + 1e-12) * (1 - np.eye(n))
    d = np.ones((len(M), n))  # squares of the scalings
    for _ in range(_SWEEPS if n > 1 else 0):
        for i in range(n):
            d[:, i] = np.sqrt(np.sum(squared[:, :, i] * d, axis=1) / np.sum(squared[:, i, :] / d, axis=1))
    d = np.sqrt(d / d.max(axis=1, keepdims=True))
    return np.repeat(d, [b.columns for b in structure.blocks], axis=1), np.repeat(d, [b.rows for b in structure.blocks], axis=1)


def _centre(M: Array, x: Array, level: Array, E_L: Array, E_R: Array) -> Array:
    """Analytic centre by damped Newton steps: minimise ``-logdet(lambda X_R - M^H X_L M) - logdet X - logdet(I - X)``."""
    pushed = adjoint(M)[:, None] @ E_L @ M[:, None]
    dS = level[:, None, None, None] * E_R - pushed
    k = x.shape[1]
    for _ in range(_NEWTON):
        S = np.einsum("fk,fkij->fij", x, dS)
        X = np.tensordot(x, E_L, 1)
        I_X = np.eye(X.shape[-1]) - X
        weighted = [(np.linalg.inv(S)[:, None] @ dS), np.linalg.inv(X)[:, None] @ E_L, -(np.linalg.inv(I_X)[:, None] @ E_L)]
        gradient = -sum(np.real(np.einsum("fkii->fk", w)) for w in weighted)
        hessian = sum(np.real(np.einsum("fkij,flji->fkl", w, w, optimize=True)) for w in weighted)
        size = np.sqrt(np.einsum("fkk->fk", hessian))
        hessian = hessian / (size[:, :, None] * size[:, None, :]) + _RIDGE * np.eye(k)
        step = -np.linalg.solve(hessian, (gradient / size)[..., None])[..., 0] / size
        decrement = np.sqrt(np.maximum(-np.sum(gradient * step, axis=1), 0.0))
        x = x + step / (1 + decrement * (decrement > 0.25))[:, None]
        if decrement.max(initial=0.0) < 0.05:
            break
    return x
