r"""Sharper bound of the worst element of the matrix ball: a Lagrangian dual with one multiplier per row and column.

With singular value decompositions ``P = U diag(s) V^H``, ``Q = G diag(q) H^H`` and ``Theta' = V^H Theta G``,

    ||a + P Theta Q||_F^2 = ||a||_F^2 + sum_ij s_i^2 q_j^2 |Theta'_ij|^2 + 2 Re sum_ij conj(c_ij) Theta'_ij,
    c_ij = s_i q_j (U^H a H)_ij.

A contraction has rows and columns of norm at most one. Giving them multipliers g_i, l_j >= 0 with ``g_i + l_j >= s_i^2
q_j^2`` and completing the square, every element of the ball obeys

    ||a + P Theta Q||_F^2 <= ||a||_F^2 + sum_i g_i + sum_j l_j + sum_ij |c_ij|^2 / (g_i + l_j - s_i^2 q_j^2).

*Any* feasible multipliers give a valid bound; coordinate descent only makes it good. For ``a = 0`` it is
``sum s_i^2 q_i^2``, for scalars
``(|a| + s q)^2``: both exact.

Symbols
-------
a : (f, p, m);  P : (f, p, b);  Q : (f, a, m), over f frequencies, Theta (f, b, a);  d_ij = s_i^2 q_j^2
"""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt

from ...core.linalg import adjoint

Array = npt.NDArray[Any]

_SWEEPS = 10
_STEPS = 4


def dual_bound(a: Array, P: Array, Q: Array) -> Array:
    """Upper bound of ``max ||a + P Theta Q||_F`` over contractions, shape (f,)."""
    U, s, _ = np.linalg.svd(P, full_matrices=False)
    _, q, Hh = np.linalg.svd(Q, full_matrices=False)
    d = (s[..., :, None] * q[..., None, :]) ** 2
    rotated = adjoint(U) @ a @ adjoint(Hh)
    c = d * np.abs(rotated) ** 2
    g, multipliers = _without_centre(s, q)
    g = g + np.sqrt(c.sum(axis=(-2, -1)) / max(s.shape[-1], 1))[..., None]
    g, multipliers = _descended(c, d, g, multipliers)
    rounding = 4 * np.finfo(float).eps
    g = g + rounding * (g + d.max(axis=-1, initial=0.0))  # else the slack of a tiny centre is rounded to zero
    slack = g[..., :, None] + multipliers[..., None, :] - d
    rest = np.where(c > 0, c / np.maximum(slack, 1e-150), 0.0).sum(axis=(-2, -1))
    squared = np.sum(np.abs(a) ** 2, axis=(-2, -1)) + g.sum(axis=-1) + multipliers.sum(axis=-1) + rest
    return np.where(np.isfinite(squared), np.sqrt(squared), np.inf)


def _without_centre(s: Array, q: Array) -> tuple[Array, Array]:
    """Optimal multipliers for ``a = 0``: the dual of the sorted assignment (s and q descend)."""
    rows, columns = s.shape[-1], q.shape[-1]
    size = max(rows, columns)
    s, q = (np.concatenate([x, np.zeros((*x.shape[:-1], size - x.shape[-1]))], axis=-1) for x in (s, q))
    following = np.concatenate([s[..., 1:] ** 2, np.zeros((*s.shape[:-1], 1))], axis=-1)
    steps = (s**2 - following) * q**2
    g = np.cumsum(steps[..., ::-1], axis=-1)[..., ::-1]
    return g[..., :rows], np.maximum(s**2 * q**2 - g, 0.0)[..., :columns]


def _descended(c: Array, d: Array, g: Array, multipliers: Array) -> tuple[Array, Array]:
    """Return better multipliers of rows and columns, by turns.

    With frequencies last, where sums over few entries are those of long vectors.
    """
    c, d = (np.ascontiguousarray(np.moveaxis(x, (-2, -1), (0, 1))) for x in (c, d))
    c_columns, d_columns = (np.ascontiguousarray(np.swapaxes(x, 0, 1)) for x in (c, d))
    rows, columns = np.moveaxis(g, -1, 0), np.moveaxis(multipliers, -1, 0)
    for _ in range(_SWEEPS):
        rows = _best_rows(c, columns - d)
        columns = _best_rows(c_columns, rows - d_columns)
    return np.moveaxis(rows, 0, -1), np.moveaxis(columns, 0, -1)


def _best_rows(c: Array, shift: Array) -> Array:
    """Minimise ``x + sum_j c_ij / (x + shift_ij)`` over ``x >= 0``, ``x + shift_ij >= 0``, for every row i."""
    least = np.maximum(np.max(-shift, axis=1), 0.0)
    gap = least[:, None] + shift
    x = np.maximum(np.max(np.sqrt(c) - gap, axis=1), 0.0)
    for _ in range(_STEPS):
        inverse = 1 / np.maximum(x[:, None] + gap, 1e-150)
        terms = c * inverse * inverse
        h = np.maximum(terms.sum(axis=1), 1e-300)
        slope = np.maximum((terms * inverse).sum(axis=1), 1e-300)
        x = np.maximum(x + (h * np.sqrt(h) - h) / slope, 0.0)
    return least + x
