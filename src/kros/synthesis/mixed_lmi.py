r"""The linear matrix inequalities of mixed H2/H-infinity synthesis with a common Lyapunov matrix, in discrete time.

With ``Q = [[X, M], [M', *]]`` and ``Q^-1 = [[Y, N], [N', *]]`` the change of variables (Scherer, Gahinet and Chilali 1997; Caverly and
Forbes, *LMI properties and applications*, 5.4.4)

    C_n = D^c C2 X + C^c M',   B_n = Y B2 D^c + N B^c,   D_n = D^c,
    A_n = Y (A + B2 D^c C2) X + N B^c C2 X + Y B2 C^c M' + N A^c M'

makes ``P = [[X, I], [I, Y]]`` and the closed-loop matrices A~, B~, C~, D~ affine. Sampled plants have A close to I, and then the inequality
between P and A~ is a small difference of large matrices. So the unknown is ``V = A~ - P`` and the rows are combined accordingly (a congruence):

    H2:    [[-V-V', V, B~1], [., P, 0], [., ., I]] > 0,   [[Z, C~1, D~11], [., P, 0], [., ., I]] > 0,   min tr Z
    Hinf:  [[-V-V', V, B~2, -C~2'], [., P, 0, C~2'], [., ., I, D~22'], [., ., ., gamma^2 I]] > 0

In balanced coordinates P has the diagonal (s, s); rows and columns are divided by its root. Strictness is ``>= eps I``, never ``>= eps``.

Symbols
-------
X, Y, A_n (through A_n - I), B_n, C_n, D_n, Z : the variables
"""

from __future__ import annotations

import warnings
from dataclasses import dataclass
from importlib import import_module
from typing import Any

import numpy as np
import numpy.typing as npt

from ..core.lti import StateSpace
from .generalized_plant import GeneralizedPlant

Array = npt.NDArray[Any]

_STRICT = 1e-9
# Least eigenvalue of the scaled P: keeps I - X Y away from singular, without which the controller cannot be recovered. It costs about as much.
_MARGIN = 1e-3


def _cvxpy() -> Any:
    """Import cvxpy when it is needed: it takes a second. Its own annotations do not describe what it exports."""
    return import_module("cvxpy")


@dataclass(frozen=True, eq=False)
class Solution:
    """What a solver returned: its word, the value of tr Z, and the controller that follows (for D22 = 0)."""

    word: str
    value: float
    controller: StateSpace


@dataclass(frozen=True, eq=False)
class Attempt:
    """A rung of the ladder: solver and its settings."""

    solver: str
    settings: dict[str, Any]


def ladder(time_limit_s: float, *, last_resort: bool) -> list[Attempt]:
    """Return the solvers to try, in order, each with the time limit; the slow first-order solver is the last resort.

    Clarabel with dense blocks and a supernodal factorisation is fastest; a moderate accuracy is enough, since everything is verified.
    """
    cp = _cvxpy()

    installed = cp.installed_solvers()
    if last_resort:
        return [Attempt("SCS", {"time_limit_secs": time_limit_s, "eps": 1e-6, "max_iters": 200000})] if "SCS" in installed else []
    accuracy = {"tol_gap_abs": 1e-4, "tol_gap_rel": 1e-4, "tol_feas": 1e-6}
    common = {"time_limit": time_limit_s, "direct_solve_method": "faer", **accuracy}
    attempts = [
        Attempt("CLARABEL", {**common, "chordal_decomposition_enable": False}),
        Attempt("CLARABEL", {**common, "chordal_decomposition_enable": True}),
        Attempt("CLARABEL", {**common, "chordal_decomposition_enable": False, "static_regularization_constant": 1e-7}),
        Attempt("MOSEK", {"mosek_params": {"MSK_DPAR_OPTIMIZER_MAX_TIME": time_limit_s}}),
    ]
    return [a for a in attempts if a.solver in installed]


class MixedInequalities:
    """The inequalities of one plant, built once and handed to several solvers.

    Parameters
    ----------
    plant : GeneralizedPlant
        Balanced, with D22 = 0.
    sizes : ndarray, shape (n,)
        Diagonal of X and Y to be expected.
    gamma : float
        Level of the H-infinity constraint.
    """

    def __init__(self, plant: GeneralizedPlant, sizes: Array, gamma: float) -> None:
        cp = _cvxpy()

        self.plant = plant
        n, _, n_u, _, n_y = plant.sizes
        self.X, self.Y = cp.Variable((n, n), symmetric=True), cp.Variable((n, n), symmetric=True)
        self.An, self.Bn = cp.Variable((n, n)), cp.Variable((n, n_y))
        self.Cn, self.Dn = cp.Variable((n_u, n)), cp.Variable((n_u, n_y))
        n_z1 = plant.C1[plant.rows(1)].shape[0]
        self.Z = cp.Variable((n_z1, n_z1), symmetric=True)
        self._scale = np.diag(1 / np.sqrt(np.concatenate([sizes, sizes])))
        self.problem = cp.Problem(cp.Minimize(cp.trace(self.Z)), self._constraints(gamma))

    def _common(self) -> tuple[Any, Any]:
        """P and V = A~ - P, scaled."""
        cp = _cvxpy()

        p, eye = self.plant, np.eye(self.plant.sizes[0])
        less = p.A - eye
        P = cp.bmat([[self.X, eye], [eye, self.Y]])
        V = cp.bmat([[less @ self.X + p.B2 @ self.Cn, less + p.B2 @ self.Dn @ p.C2], [self.An, self.Y @ less + self.Bn @ p.C2]])
        return self._scale @ P @ self._scale, self._scale @ V @ self._scale

    def _channel(self, rows: slice, columns: slice) -> tuple[Any, Any, Any]:
        """B~, C~, D~ of one channel, scaled; disturbances without effect on it are left out."""
        cp = _cvxpy()

        part = self.plant.channel(rows, columns)
        used = np.any(np.vstack([part.B1, part.D21, part.D11]), axis=0)
        B1, D21, D11 = part.B1[:, used], part.D21[:, used], part.D11[:, used]
        B = cp.vstack([B1 + part.B2 @ self.Dn @ D21, self.Y @ B1 + self.Bn @ D21])
        C = cp.hstack([part.C1 @ self.X + part.D12 @ self.Cn, part.C1 + part.D12 @ self.Dn @ part.C2])
        return self._scale @ B, C @ self._scale, D11 + part.D12 @ self.Dn @ D21

    def _constraints(self, gamma: float) -> list[Any]:
        cp = _cvxpy()

        p = self.plant
        P, V = self._common()
        B, C, D = self._channel(p.rows(1), p.columns(1))
        n, n_w = P.shape[0], B.shape[1]
        zero, eye = np.zeros((n, n_w)), np.eye(n_w)
        blocks = [
            cp.bmat([[-V - V.T, V, B], [V.T, P, zero], [B.T, zero.T, eye]]),
            cp.bmat([[self.Z, C, D], [C.T, P, zero], [D.T, zero.T, eye]]),
        ]
        if p.C1[p.rows(2)].shape[0] and p.B1[:, p.columns(2)].shape[1]:
            B, C, D = self._channel(p.rows(2), p.columns(2))
            n_w, level = B.shape[1], gamma**2 * np.eye(C.shape[0])
            zero = np.zeros((n, n_w))
            blocks.append(cp.bmat([[-V - V.T, V, B, -C.T], [V.T, P, zero, C.T], [B.T, zero.T, np.eye(n_w), D.T], [-C, C, D, level]]))
        strict = [(b + b.T) / 2 - _STRICT * np.eye(b.shape[0]) >> 0 for b in blocks]
        return [*strict, (P + P.T) / 2 - _MARGIN * np.eye(n) >> 0]

    def solve(self, attempt: Attempt) -> Solution | str:
        """Solve with one solver; return the solution, or the reason why there is none."""
        cp = _cvxpy()

        try:
            with warnings.catch_warnings():
                warnings.filterwarnings("ignore", message="Solution may be inaccurate")  # the status says so, and verification follows
                self.problem.solve(solver=attempt.solver, **attempt.settings)
        except (cp.error.SolverError, ValueError, ArithmeticError) as error:
            return f"{attempt.solver}: {error}"
        if self.X.value is None or self.problem.value is None or not np.isfinite(self.problem.value):
            return f"{attempt.solver}: {self.problem.status}"
        try:
            return Solution(str(self.problem.status), float(self.problem.value), self._recover())
        except np.linalg.LinAlgError as error:
            return f"{attempt.solver}: the controller cannot be recovered ({error})"

    def _recover(self) -> StateSpace:
        """Controller (for D22 = 0) from the variables; ``M N' = I - X Y``."""
        p = self.plant
        X, Y, Bn, Cn, Dn = (v.value for v in (self.X, self.Y, self.Bn, self.Cn, self.Dn))
        eye = np.eye(len(X))
        U, s, Vh = np.linalg.svd(eye - X @ Y)
        M, N = U * np.sqrt(s), Vh.T * np.sqrt(s)
        C = np.linalg.solve(M, (Cn - Dn @ p.C2 @ X).T).T
        B = np.linalg.solve(N, Bn - Y @ p.B2 @ Dn)
        middle = self.An.value + eye - N @ B @ p.C2 @ X - Y @ p.B2 @ C @ M.T - Y @ (p.A + p.B2 @ Dn @ p.C2) @ X
        A = np.linalg.solve(M, np.linalg.solve(N, middle).T).T
        return StateSpace(A, B, C, Dn, p.dt)
