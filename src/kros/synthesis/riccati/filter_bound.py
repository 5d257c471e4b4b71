r"""Errors that no predictor beats, proven without the Riccati equation: any solution of its inequality will do.

For ``x+ = A x + B nu``, ``y = C x + D nu`` with white ``nu`` of unit covariance, every symmetric P with

.. math:: M(P) = \begin{bmatrix} A \\ C \end{bmatrix} P \begin{bmatrix} A \\ C \end{bmatrix}^T
          + \begin{bmatrix} B \\ D \end{bmatrix} \begin{bmatrix} B \\ D \end{bmatrix}^T
          - \begin{bmatrix} P & 0 \\ 0 & 0 \end{bmatrix} \succeq 0

lies below the error covariance of every one-step predictor: the step of the optimal filter is monotone and does not
take P below itself, and a stable error forgets where it began. So ``tr(Z P Z^T)`` bounds the power of ``Z (x - x_hat)``
from below, whatever P was made from.

P is made from a Riccati solution, moved down by what rounding may do to the inequality, carried through the closed loop
by a Lyapunov equation. That the inequality holds is read from the eigenvalues of M(P) less a bound of every rounding
error, in states of similar size (scaled by powers of two, which is exact).
"""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt

from ...core.errors import SynthesisError
from ...core.norms import gramian
from .kalman import predictor

Array = npt.NDArray[Any]

_EPS = float(np.finfo(float).eps)
_FIRST, _GROWTH, _TRIES = 4.0, 16.0, 12


def predictor_bound(A: Array, B: Array, C: Array, D: Array, Z: Array) -> float | None:
    """Return a squared error ``E |Z (x - x_hat)|^2`` that no one-step predictor beats.

    None where none above zero could be proven.
    """
    n = len(A)
    if not n or not Z.any():
        return None
    size = _sizes(A, B)
    A, B, C, Z = A * size / size[:, None], B / size[:, None], C * size, Z * size
    F, W = np.vstack([A, C]), np.vstack([B, D])
    try:
        L, P = predictor(A, C, B @ B.T, D @ D.T, B @ D.T, "Lower bound")
    except SynthesisError:
        return None
    M, margin = _inequality(F, W, P)
    margin = margin + 4 * len(F) ** 2 * _EPS * np.abs(np.diag(M))
    load = np.diag(margin[:n]) + (L * margin[n:]) @ L.T
    if not np.isfinite(load).all():
        return None
    down = _stationary(A - L @ C, np.linalg.cholesky(load + np.diag(_EPS * np.diag(load) + 1e-300)))
    if not np.isfinite(down).all():
        return None
    factor = _FIRST
    for _ in range(_TRIES):
        lower = P - factor * down
        if _holds(F, W, lower):
            squared = float(
                np.trace(Z @ lower @ Z.T) - 4 * n * _EPS * np.trace(np.abs(Z) @ np.abs(lower) @ np.abs(Z.T))
            )
            return squared if squared > 0 else None
        factor *= _GROWTH
    return None


def _sizes(A: Array, B: Array) -> Array:
    """Sizes of the states, powers of two; all one where some state does not settle."""
    power = np.diag(_stationary(A, B)) if np.abs(np.linalg.eigvals(A)).max() < 1 else np.ones(len(A))
    if not np.isfinite(power).all():
        return np.ones(len(A))
    return np.asarray(2.0 ** np.round(np.log2(np.where(power > 0, power, 1.0)) / 2))


def _stationary(A: Array, B: Array) -> Array:
    with np.errstate(over="ignore", invalid="ignore"):
        return gramian(A, B, 1.0)


def _inequality(F: Array, W: Array, P: Array) -> tuple[Array, Array]:
    """M(P), and for every row a bound of the sum of its rounding errors."""
    n = len(P)
    M, size = F @ P @ F.T + W @ W.T, np.abs(F) @ np.abs(P) @ np.abs(F.T) + np.abs(W) @ np.abs(W.T)
    M[:n, :n] -= P
    size[:n, :n] += np.abs(P)
    return (M + M.T) / 2, (2 * n + W.shape[1] + 8) * _EPS * size.sum(axis=1)


def _holds(F: Array, W: Array, P: Array) -> bool:
    """Whether M(P) is positive semidefinite in exact arithmetic: its eigenvalues exceed all errors of rounding."""
    M, margin = _inequality(F, W, P)
    M = M - np.diag(margin)
    power = np.diag(M)
    if not np.isfinite(M).all() or (power <= 0).any():
        return False
    root = 2.0 ** np.round(np.log2(power) / 2)
    return bool(np.linalg.eigvalsh(M / root / root[:, None])[0] > 4 * len(M) ** 2 * _EPS)
