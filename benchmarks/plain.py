"""The published algorithms, each as plainly as it can be written: what `bench_stages.py` compares kros with, besides other packages."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import cvxpy as cp
import numpy as np
import numpy.typing as npt
from scipy.linalg import solve_continuous_are

from kros.core.lti import StateSpace
from kros.observer import Observer
from kros.synthesis import GeneralizedPlant

Array = npt.NDArray[Any]


def edmd(x: Array, u: Array, lift: Callable[[Array], Array], alpha: float) -> Array:
    """Return [A B] by the regularised normal equations, (32)."""
    Psi, Theta = np.hstack([lift(x[:-1]), u[:-1]]).T, lift(x[1:]).T
    return np.linalg.solve(Psi @ Psi.T + alpha * np.eye(len(Psi)), Psi @ Theta.T).T


def free_run(A: Array, B: Array, lift: Callable[[Array], Array], x0: Array, u: Array) -> Array:
    """Return the states of one episode, lifted anew at every sample."""
    x = np.empty((len(u), len(x0)))
    x[0] = x0
    for k in range(len(u) - 1):
        x[k + 1] = (A @ lift(x[k]) + B @ u[k])[: len(x0)]
    return x


def observe(o: Observer, lift: Callable[[Array], Array], y: Array, u: Array) -> Array:
    """Return predictions of one episode: the correction enters the state, which is lifted anew at every sample."""
    x, w = np.zeros((len(u), o.lifting.n_states)), np.zeros(o.controller.n_states)
    x[0, list(o.measured)] = y[0]
    for k in range(len(u) - 1):
        r = y[k] - x[k, list(o.measured)]
        x[k + 1] = (o.A @ lift(x[k]) + o.B @ u[k] + o.controller.C @ w + o.controller.D @ r)[: x.shape[1]]
        w = o.controller.A @ w + o.controller.B @ r
    return x


def response(system: StateSpace, freqs_hz: Array) -> Array:
    """Return C (z I - A)^-1 B + D of one system, a frequency at a time."""
    z = np.exp(2j * np.pi * freqs_hz * system.dt)
    return np.array([system.C @ np.linalg.solve(s * np.eye(len(system.A)) - system.A, system.B) + system.D for s in z])


def peaks(G: Array) -> Array:
    """Return the largest inverse input multiplicative residual of all other units for every nominal, from all pairs."""
    eye, found = np.eye(G.shape[-1]), np.zeros(len(G))
    for i, nominal in enumerate(G):
        for other in np.delete(G, i, axis=0):
            E = eye - np.linalg.pinv(other) @ nominal
            found[i] = max(found[i], np.linalg.norm(E, 2, axis=(-2, -1)).max())
    return found


def h2(p: GeneralizedPlant) -> StateSpace:
    """Return the H2 controller of a continuous regular plant from two Riccati equations."""
    X = solve_continuous_are(p.A, p.B2, p.C1.T @ p.C1, p.D12.T @ p.D12, s=p.C1.T @ p.D12)
    Y = solve_continuous_are(p.A.T, p.C2.T, p.B1 @ p.B1.T, p.D21 @ p.D21.T, s=p.B1 @ p.D21.T)
    F = -np.linalg.solve(p.D12.T @ p.D12, p.B2.T @ X + p.D12.T @ p.C1)
    L = -np.linalg.solve(p.D21 @ p.D21.T, p.C2 @ Y + p.D21 @ p.B1.T).T
    return StateSpace(p.A + p.B2 @ F + L @ p.C2 + L @ p.D22 @ F, -L, F, np.zeros((len(F), len(p.C2))), 0.0)


def mixed(p: GeneralizedPlant) -> float:
    """Return the bound of the H2 norm from w1 to z1 with an H-infinity norm below one from w2 to z2: linear matrix inequalities in CVXPY.

    Discrete, with one Lyapunov matrix for both norms and the change of variables of Scherer, Gahinet and Chilali (1997).
    """
    n, n_w, n_u, n_z, n_y = p.sizes
    w1, z1 = p.n_w1, p.n_z1
    X, Y = (cp.Variable((n, n), symmetric=True) for _ in range(2))
    An, Bn, Cn, Dn = (cp.Variable(shape) for shape in ((n, n), (n, n_y), (n_u, n), (n_u, n_y)))
    Z = cp.Variable((z1, z1), symmetric=True)
    P = cp.bmat([[Y, np.eye(n)], [np.eye(n), X]])
    A = cp.bmat([[p.A @ Y + p.B2 @ Cn, p.A + p.B2 @ Dn @ p.C2], [An, X @ p.A + Bn @ p.C2]])

    def channel(w: slice, z: slice) -> tuple[Any, Any, Any]:
        C1, D12, B1, D21 = p.C1[z], p.D12[z], p.B1[:, w], p.D21[:, w]
        B = cp.bmat([[B1 + p.B2 @ Dn @ D21], [X @ B1 + Bn @ D21]])
        return B, cp.bmat([[C1 @ Y + D12 @ Cn, C1 + D12 @ Dn @ p.C2]]), p.D11[z, w] + D12 @ Dn @ D21

    B, C, D = channel(slice(w1), slice(z1))
    H2 = [
        cp.bmat([[P, A, B], [A.T, P, np.zeros((2 * n, w1))], [B.T, np.zeros((w1, 2 * n)), np.eye(w1)]]),
        cp.bmat([[Z, C, D], [C.T, P, np.zeros((2 * n, w1))], [D.T, np.zeros((w1, 2 * n)), np.eye(w1)]]),
    ]
    B, C, D = channel(slice(w1, None), slice(z1, None))
    w2, z2 = n_w - w1, n_z - z1
    zero = np.zeros
    Hinf = cp.bmat(
        [
            [P, A, B, zero((2 * n, z2))],
            [A.T, P, zero((2 * n, w2)), C.T],
            [B.T, zero((w2, 2 * n)), np.eye(w2), D.T],
            [zero((z2, 2 * n)), C, D, np.eye(z2)],
        ]
    )
    problem = cp.Problem(cp.Minimize(cp.trace(Z)), [(M + M.T) / 2 >> 0 for M in (*H2, Hinf)])
    problem.solve(solver="CLARABEL")
    return float(np.sqrt(problem.value)) if problem.status in ("optimal", "optimal_inaccurate") else np.nan
