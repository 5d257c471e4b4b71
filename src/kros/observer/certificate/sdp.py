r"""Lyapunov matrices by a semidefinite program over the corners, that look at slopes to come where one matrix does not do.

Without lookahead one P serves all corners (quadratic stability). With a lookahead of m there is a matrix for every word of the next m corners,

    V_k = sum over words v of  lambda_v(d_k, ..., d_{k+m-1}) xi' P_v xi,

lambda the weights of the slopes between corners: m = 1 is the parameter-dependent function P(d), more is a path-complete graph of words
(a De Bruijn graph). Every step that begins with corner c gives one inequality, linear in P and gamma^2,

    A_c' P_v' A_c - P_v + C'C <= ...,        see `relift_proof`.

Sampled systems have A close to I: the difference ``A'PA - P`` is written ``N'P + PN + N'PN`` with ``N = A - I``, in coordinates where a
reachability Gramian is the identity. The first program finds the least gamma, a second one, a little above, the strictest decrease there.
"""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from importlib import import_module
from typing import Any

import numpy as np
import numpy.typing as npt

from ...core.norms import gramian
from .error import ErrorSystem
from .proof import margin, steps
from .riccati import Proposal

Array = npt.NDArray[np.float64]
_ABOVE = (1.003, 1.02, 1.1, 1.5)
_STRICT = 1e-9
_HOW = ("one Lyapunov matrix for all corners", "a Lyapunov matrix for every corner", "a Lyapunov matrix for every pair of corners")


def sdp_proposal(
    system: ErrorSystem, corners: Sequence[tuple[Array, Array]], lookahead: int = 0, time_limit_s: float = 20.0
) -> tuple[Proposal | None, str]:
    """Return the best proposal that holds in floating point, and what the solver said.

    `corners` are those (A, B) of every mode; the Lyapunov function looks at so many coming corners as `lookahead` says; the time limit is one for each program.
    """
    cp: Any = import_module("cvxpy")  # takes a second; its own annotations do not describe what it exports
    n, n_words = len(system.A), len(corners) ** lookahead
    T, size = _coordinates(system, corners)
    scaled = [(np.linalg.solve(T, (A - np.eye(n)) @ T), np.linalg.solve(T, B) / size) for A, B in corners]
    C = system.C @ T
    matrices = [cp.Variable((n, n), symmetric=True) for _ in range(n_words)]
    level, slack = cp.Variable(), cp.Variable()
    unit = max(float(np.linalg.norm(C, 2)) ** 2, np.finfo(float).tiny)
    constraints = [P - _STRICT * np.eye(n) >> 0 for P in matrices]
    for c, one, following in steps(len(corners), n_words):
        N, B = scaled[c]
        P, after = matrices[one], matrices[following]
        state = P - after - N.T @ after - after @ N - N.T @ after @ N - C.T @ C / unit
        cross = -(after + N.T @ after) @ B
        F = cp.bmat([[state, cross], [cross.T, level * np.eye(B.shape[1]) - B.T @ after @ B]])
        constraints.append((F + F.T) / 2 - slack * np.eye(F.shape[0]) >> 0)
    least, word = _solve(cp.Problem(cp.Minimize(level), [*constraints, slack == 0]), level, time_limit_s)
    if least is None or least <= 0:
        return None, word
    bound = float(np.sqrt(least * unit)) * size
    for factor in _ABOVE:
        strictest, word = _solve(cp.Problem(cp.Maximize(slack), [*constraints, level == least * factor**2]), slack, time_limit_s)
        if strictest is None or strictest <= 0:
            continue
        try:
            roots = np.array([np.linalg.qr(np.linalg.cholesky(P.value * unit).T @ np.linalg.inv(T), mode="r") for P in matrices])
        except np.linalg.LinAlgError:  # not positive definite after all
            continue
        if margin(roots, corners, system.C, bound * factor) > 0:
            return Proposal(bound * factor, roots, _HOW[min(lookahead, 2)]), word
    return None, word


def _coordinates(system: ErrorSystem, corners: Sequence[tuple[Array, Array]]) -> tuple[Array, float]:
    """Return the root of a reachability Gramian of the middle of the corners, and the size of the output it leads to."""
    A = np.mean([corner[0] for corner in corners], axis=0)
    B = np.hstack([system.L, *[corner[1] for corner in corners]])
    radius = float(np.abs(np.linalg.eigvals(A)).max(initial=0.0))
    A = A * min(1.0, 0.999 / max(radius, 1e-12))
    W = gramian(A, B, system.dt)
    diagonal = np.sqrt(np.maximum(np.diag(W), 0.0))
    diagonal[diagonal == 0] = 1.0
    values, vectors = np.linalg.eigh(W / np.outer(diagonal, diagonal))
    T = diagonal[:, None] * vectors * np.sqrt(np.maximum(values, 1e-8 * values.max()))
    return T, float(max(np.linalg.norm(np.linalg.solve(T, corner[1]), 2) for corner in corners)) or 1.0


def _solve(problem: Any, value: Any, time_limit_s: float) -> tuple[float | None, str]:
    """Return the value of one variable, None where there is no solution, and the solver's word; what it claims is proven elsewhere."""
    error = import_module("cvxpy").error.SolverError
    try:
        with warnings.catch_warnings():
            warnings.filterwarnings("ignore", message="Solution may be inaccurate")
            problem.solve(solver="CLARABEL", time_limit=time_limit_s)
    except (error, ValueError, ArithmeticError) as failure:
        return None, f"Clarabel: {failure}"
    word = f"Clarabel: {problem.status}"
    if value.value is None or not np.isfinite(value.value) or problem.status not in ("optimal", "optimal_inaccurate"):
        return None, word
    return float(value.value), word
