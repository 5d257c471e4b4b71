"""Poles, H2 norms and gains in multiple precision, for systems whose numbers double precision cannot tell."""

from __future__ import annotations

from typing import Any

import numpy as np

from .errors import SynthesisError
from .lti import StateSpace
from .rounding import ITERATED

DIGITS, MOST_DIGITS, MOST_STATES = 40, 160, 60


def precise_h2_norm(system: StateSpace) -> float:
    """H2 norm by eigenvectors of A, infinite where a pole is not stable; digits double until two results agree."""
    import mpmath

    if system.n_states > MOST_STATES:
        problem = f"double precision does not suffice, and multiple precision takes at most {MOST_STATES} states"
        raise SynthesisError(f"H2 norm: {problem}, found {system.n_states}; reduce the system, or scale its states.")
    before, digits = None, DIGITS
    while digits <= MOST_DIGITS:
        with mpmath.workdps(digits):
            norm = _h2_norm(mpmath, system)
        if before is not None and (norm == before or abs(norm - before) <= ITERATED * abs(norm)):
            return norm
        before, digits = norm, 2 * digits
    problem = f"no two results agree with up to {MOST_DIGITS} digits"
    raise SynthesisError(f"H2 norm: {problem}; the system has poles on the stability limit.")


def _h2_norm(mp: Any, system: StateSpace) -> float:
    """``tr(C P C^T + D D^T)``, ``P = V X V^H``, ``X_ij = M_ij / (1 - l_i l_j*)`` or ``-M_ij / (l_i + l_j*)``."""
    n, discrete = system.n_states, system.dt > 0
    A, B, C = (mp.matrix(matrix.tolist()) for matrix in (system.A, system.B, system.C))
    poles, V = mp.eig(A)
    limit = mp.mpf(10) ** (-mp.mp.dps // 3)  # an eigenvalue of multiplicity three is known to a third of the digits
    if any(abs(p) >= 1 - limit if discrete else mp.re(p) >= -limit * max(abs(q) for q in poles) for p in poles):
        return float("inf")
    W = mp.lu_solve(V, B) if B.cols == 1 else mp.inverse(V) * B
    M, G = W * W.transpose_conj(), C * V
    X = mp.matrix(n, n)
    for i in range(n):
        for j in range(n):
            other = mp.conj(poles[j])
            X[i, j] = M[i, j] / (1 - poles[i] * other if discrete else -(poles[i] + other))
    squared = sum(mp.re((G[i, :] * X * G[i, :].transpose_conj())[0, 0]) for i in range(C.rows))
    return float(mp.sqrt(squared + (mp.mpf(float(np.sum(system.D**2))) if discrete else 0)))


def precise_gain(system: StateSpace, freq_hz: float) -> float:
    """Largest singular value at one frequency, the resolvent in multiple precision."""
    import mpmath

    with mpmath.workdps(DIGITS):
        s = mpmath.mpc(0, 2 * mpmath.pi * mpmath.mpf(freq_hz))
        point = mpmath.exp(s * mpmath.mpf(system.dt)) if system.dt > 0 else s
        A, B, C, D = (mpmath.matrix(matrix.tolist()) for matrix in (system.A, system.B, system.C, system.D))
        response = C * mpmath.inverse(point * mpmath.eye(system.n_states) - A) * B + D
        values = np.array([[complex(response[i, j]) for j in range(response.cols)] for i in range(response.rows)])
    return float(np.linalg.norm(values, 2))
