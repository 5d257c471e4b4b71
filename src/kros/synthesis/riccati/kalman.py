"""Steady-state Kalman predictor: a constant correction of the state, ``x_hat+ = A x_hat + B u + L (y - C x_hat)``.

Symbols
-------
Q, R : process and measurement noise covariance;  P : covariance of the one-step prediction error;  L : gain, shape (n,
    q)
"""

from __future__ import annotations

import time

import numpy as np

from ...core.arrays import AnyArray, ArrayLike
from ...core.errors import DimensionError, SynthesisError
from ...core.lti import StateSpace, gain
from ...core.norms import h2_norm
from ...core.rounding import ROUNDING, TINY
from ..assumptions import require_detectable
from ..result import Injection, Status, Synthesis
from .equations import discrete_gain, solve_riccati


def kalman(A: ArrayLike, C: ArrayLike, Q: ArrayLike, R: ArrayLike, dt: float = 1.0) -> Synthesis:
    """Return the steady-state Kalman predictor as a constant correction of the state.

    Parameters
    ----------
    A : array_like, shape (n, n)
        Discrete dynamics.
    C : array_like, shape (q, n)
        Measured combinations of the state.
    Q : array_like, shape (n, n)
        Process noise covariance, positive semidefinite.
    R : array_like, shape (q, q)
        Measurement noise covariance, positive definite.
    dt : float, s
        Sampling period of the result.

    Returns
    -------
    Synthesis
        ``controller.D`` is the gain L, shape (n, q); ``h2_norm`` is the root of the trace of the prediction error's
        covariance.

    Raises
    ------
    DimensionError
        When sizes do not fit.
    SynthesisError
        When R is not positive definite, Q not positive semidefinite, or the pair (A, C) undetectable (the mode is
        named).

    Examples
    --------
    >>> from kros.synthesis import kalman
    >>> synthesis = kalman([[1.0]], [[1.0]], [[1.0]], [[2.0]])
    >>> float(synthesis.controller.D[0, 0])  # P = 2, L = 2 / (2 + 2)
    0.5
    """
    A, C, Q, R = (np.atleast_2d(np.asarray(x, dtype=float)) for x in (A, C, Q, R))
    n, q = A.shape[0], C.shape[0]
    if A.shape != (n, n) or C.shape != (q, n) or Q.shape != (n, n) or R.shape != (q, q):
        shapes = f"{A.shape}, {C.shape}, {Q.shape}, {R.shape}"
        raise DimensionError(f"Kalman predictor: needs A (n, n), C (q, n), Q (n, n), R (q, q), found {shapes}.")
    if np.linalg.eigvalsh((R + R.T) / 2).min() <= 0:
        raise SynthesisError("Kalman predictor: R is not positive definite; every measurement needs some noise.")
    values, vectors = np.linalg.eigh((Q + Q.T) / 2)
    if values.min() < -ROUNDING * max(values.max(), TINY):
        problem = f"Q has the eigenvalue {values.min():.3g}"
        raise SynthesisError(f"Kalman predictor: {problem}; it must be positive semidefinite.")
    require_detectable(A, C, dt, "Kalman predictor")
    start = time.perf_counter()
    L, _ = predictor(A, C, Q, R, np.zeros((n, q)), "Kalman predictor")
    elapsed = time.perf_counter() - start
    closed = A - L @ C
    radius = float(np.abs(np.linalg.eigvals(closed)).max(initial=0.0))
    if radius >= 1:
        problem = f"the error dynamics have spectral radius {radius:.9g}"
        raise SynthesisError(f"Kalman predictor: {problem}; add process noise on the modes on the unit circle.")
    noise = np.hstack([vectors * np.sqrt(np.maximum(values, 0)), -L @ np.linalg.cholesky(R)])
    norm = h2_norm(StateSpace(closed, noise, np.eye(n), np.zeros((n, n + q)), dt))
    return Synthesis(
        method="kalman",
        controller=gain(L, dt),
        status=Status.OPTIMAL,
        injection=Injection.STATE,
        h2_norm=norm,
        spectral_radius=radius,
        solve_s=elapsed,
        solver="riccati",
    )


def predictor(
    A: AnyArray, C: AnyArray, Q: AnyArray, R: AnyArray, S: AnyArray, method: str
) -> tuple[AnyArray, AnyArray]:
    """Gain and covariance of the one-step predictor for noise covariances Q, R and cross covariance S (n, q)."""
    P = solve_riccati(A.T, C.T, Q, R, S, 1.0, method)
    return -discrete_gain(A.T, C.T, R, S, P).T, P


def predictor_bound(A: AnyArray, B: AnyArray, C: AnyArray, D: AnyArray, Z: AnyArray) -> float:
    """Return the least ``E |Z (x - x_hat)|^2`` for ``x+ = A x + B nu``, ``y = C x + D nu``; zero if unknown."""
    try:
        _, P = predictor(A, C, B @ B.T, D @ D.T, B @ D.T, "Lower bound")
    except SynthesisError:
        return 0.0
    return max(float(np.trace(Z @ P @ Z.T)), 0.0)
