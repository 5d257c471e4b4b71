r"""One level of the H-infinity problem: its two Hamiltonian matrices and the central controller.

The level is solved in continuous time, for balanced states and a normalised plant, ``D12 = [0; I]``, ``D21 = [0, I]``,
``D22 = 0``. Discrete plants go through ``z = (1 + s) / (1 - s)``, which maps the unit circle to the imaginary axis and
keeps all gains, so that nothing is approximated. A controller with ``||T|| < gamma`` exists exactly when the direct
gain leaves room (Parrott), both Riccati equations have stabilising solutions, these are positive semidefinite, and
``rho(X Y) < gamma^2``.

Symbols
-------
X, Y : stabilising solutions of control and filter, (n, n); at the level infinity they balance the states
F = [F11; F12; F2] : state feedback, rows of the free disturbances, the measured ones, the control
L = [L11, L12, L2] : output injection, columns of the free outputs, the penalised ones, the measurements
E = I - Y X / gamma^2 : coupling; its inverse is Z of the source, and is never formed

References
----------
K. Zhou, J. C. Doyle, K. Glover, *Robust and Optimal Control*, theorem 17.1 (page 442); K. Glover and J. C. Doyle,
"State-space formulae for all stabilizing controllers that satisfy an H-infinity-norm bound", Systems & Control Letters
11 (1988) 167-172.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import numpy.typing as npt
from scipy.linalg import LinAlgError, schur

from ...core.errors import SynthesisError
from ...core.linalg import balanced_size, balancing
from ...core.lti import StateSpace
from ...core.norms import to_continuous
from ..generalized_plant import GeneralizedPlant, split
from .equations import absorb_feedthrough, solve_riccati

Array = npt.NDArray[Any]

_AXIS = 1e-14  # distance of an eigenvalue from the axis, relative to the matrix, that rounding decides
_NEGATIVE, _ASYMMETRY = 1e-7, 1e-5  # of a Riccati solution, relative: beyond them there is none that is semidefinite
_POLE = 1e12  # condition above which a pole is at z = -1, the point that the map sends to infinity


@dataclass(frozen=True, eq=False)
class Half:
    """One Hamiltonian matrix.

    Its eigenvalues and, where n of them are stable, the signals ``(state, costate, z)(t) = (U, P, Z) exp(M t) c``.
    """

    eigenvalues: Array
    U: Array | None = None
    P: Array | None = None
    M: Array | None = None
    Z: Array | None = None

    @classmethod
    def of(cls, A: Array, B: Array, C: Array, D: Array, R: Array) -> Half:
        """Solve ``x' = A x + B u``, ``z = C x + D u`` with the indefinite weight ``z'z + u'(R - D'D)u``."""
        n = len(A)
        gain = np.linalg.solve(R, np.hstack([D.T @ C, B.T]))
        closed, quadratic, cost = A - B @ gain[:, :n], B @ gain[:, n:], C.T @ C - C.T @ D @ gain[:, :n]
        # Units of the costate level the blocks: rounding is relative to both, slow modes are not lost beside fast ones.
        sizes = [float(np.linalg.norm(x)) for x in (closed, quadratic, cost)]
        unit = np.sqrt(sizes[2] / sizes[1]) if sizes[1] * sizes[2] > (1e-12 * sizes[0]) ** 2 else 1.0
        H = np.block([[closed, -unit * (quadratic + quadratic.T) / 2], [-(cost + cost.T) / (2 * unit), -closed.T]])
        T, basis, stable = schur(H, output="real", sort="lhp")
        eigenvalues = np.linalg.eigvals(T)
        # LAPACK's real Schur form has the real parts of all eigenvalues on its diagonal.
        if stable != n or (n and np.abs(np.diag(T)).min() <= _AXIS * np.linalg.norm(H)):
            return cls(eigenvalues)
        U, P = basis[:n, :n], unit * basis[n:, :n]
        return cls(eigenvalues, U, P, T[:n, :n], C @ U - D @ (gain[:, :n] @ U + gain[:, n:] @ P))

    def solution(self) -> Array | None:
        """Return the stabilising Riccati solution ``P U^-1``.

        None when there is none that is semidefinite, or in doubt.
        """
        if self.U is None or self.P is None:
            return None
        if not len(self.U):
            return self.U
        product = self.U.T @ self.P
        size = np.abs(product).max()
        if np.abs(product - product.T).max() > _ASYMMETRY * max(size, 1e-3 * np.linalg.norm(self.P, 2)):
            return None
        X: Array = np.linalg.solve(self.U.T, self.P.T).T
        X = (X + X.T) / 2
        values = np.linalg.eigvalsh(X)
        lowest = -_NEGATIVE * max(values[-1], -values[0], 1e-300)
        return None if values[0] < lowest and values[0] < -1e-10 else X


@dataclass(frozen=True, eq=False)
class Frame:
    """The normalised continuous plant, and the way back to signals and controllers of the plant as it was given."""

    given: GeneralizedPlant
    scaled: GeneralizedPlant  # the given plant for D22 = 0, its states scaled by powers of two: here bounds are proven
    T: Array  # state of the normalised plant = T state of the scaled one
    back: Array
    D22: Array
    normal: GeneralizedPlant
    left: Array
    right: Array
    inputs: Array
    outputs: Array

    @classmethod
    def of(cls, given: GeneralizedPlant) -> Frame:
        """Scale, balance, map and normalise a regular plant."""
        n, n_w, n_u, n_z, n_y = given.sizes
        scaled = scale(given)
        T, back = _balancing(scaled)
        p = scaled.transformed(x=(T, back))
        if given.dt > 0:
            if n and np.linalg.cond(p.A + np.eye(n)) > _POLE:
                raise SynthesisError(
                    "H-infinity synthesis: the plant has a pole at z = -1, which no bilinear map takes to continuous "
                    "time; move it "
                    "into the stable region."
                )
            p = split(to_continuous(p.open_loop()), n_w, n_z)
        U, s, Vh = np.linalg.svd(p.D12)
        outputs, left = np.roll(U, -n_u, axis=1).T, Vh.T / s
        V, t, Wh = np.linalg.svd(p.D21)
        inputs, right = np.roll(Wh, -n_y, axis=0).T, V.T / t[:, None]
        normal = replace(
            p.transformed(z=outputs, w=inputs, y=right, u=left),
            D12=np.eye(n_z)[:, n_z - n_u :],
            D21=np.eye(n_w)[n_w - n_y :],
            D22=np.zeros((n_y, n_u)),
        )
        return cls(given, scaled, T, back, p.D22, normal, left, right, inputs, outputs)

    def halves(self, gamma: float) -> tuple[Half, Half]:
        """Return the Hamiltonian matrices of control and filter at a level.

        A `LinAlgError` where the level is a direct gain.
        """
        p = self.normal
        B, C = np.hstack([p.B1, p.B2]), np.vstack([p.C1, p.C2])
        row, column = np.hstack([p.D11, p.D12]), np.vstack([p.D11, p.D21])
        R, S = row.T @ row, column @ column.T
        R[: p.sizes[1], : p.sizes[1]] -= gamma**2 * np.eye(p.sizes[1])
        S[: p.sizes[3], : p.sizes[3]] -= gamma**2 * np.eye(p.sizes[3])
        return Half.of(p.A, B, p.C1, row, R), Half.of(p.A.T, C.T, p.B1.T, column.T, S)

    def controller(self, control: Half, filter_: Half, gamma: float) -> StateSpace | None:
        """Return the central controller of the given plant; None proves nothing, `hinf_bound` does."""
        try:
            X, Y = control.solution(), filter_.solution()
            if X is None or Y is None:
                return None
            coupling = Y @ X / gamma**2
            if np.abs(np.linalg.eigvals(coupling)).max(initial=0.0) >= 1:
                return None
            K = _central(self.normal, gamma, X, Y, np.eye(len(X)) - coupling)
            K = StateSpace(K.A, K.B @ self.right, self.left @ K.C, self.left @ K.D @ self.right, 0.0)
            K = _to_discrete(K, self.given.dt) if self.given.dt > 0 else K
            # In discrete time: for a controller with a pole at z = -1 the continuous loop would have no solution.
            return absorb_feedthrough(absorb_feedthrough(K, self.D22), self.given.D22)
        except (LinAlgError, ValueError, SynthesisError):
            return None


def _central(p: GeneralizedPlant, gamma: float, X: Array, Y: Array, E: Array) -> StateSpace:
    """Central controller of the normalised plant (Zhou, Doyle and Glover, theorem 17.1)."""
    _, n_w, n_u, n_z, n_y = p.sizes
    free_z, free_w = n_z - n_u, n_w - n_y
    row, column = np.hstack([p.D11, p.D12]), np.vstack([p.D11, p.D21])
    R = row.T @ row - gamma**2 * np.diag(np.arange(n_w + n_u) < n_w)
    S = column @ column.T - gamma**2 * np.diag(np.arange(n_z + n_y) < n_z)
    F = -np.linalg.solve(R, row.T @ p.C1 + np.hstack([p.B1, p.B2]).T @ X)
    L = -np.linalg.solve(S, column @ p.B1.T + np.vstack([p.C1, p.C2]) @ Y).T
    D1111, D1112 = p.D11[:free_z, :free_w], p.D11[:free_z, free_w:]
    D1121, D1122 = p.D11[free_z:, :free_w], p.D11[free_z:, free_w:]
    D = -D1121 @ D1111.T @ np.linalg.solve(gamma**2 * np.eye(free_z) - D1111 @ D1111.T, D1112) - D1122
    innovation = p.C2 + F[free_w:n_w]
    solved = np.linalg.solve(E, (p.B2 + L[:, free_z:n_z]) @ D - L[:, n_z:])
    A = p.A + p.B1 @ F[:n_w] + p.B2 @ F[n_w:] - solved @ innovation
    return StateSpace(A, solved, F[n_w:] - D @ innovation, D, 0.0)


def _to_discrete(K: StateSpace, dt: float) -> StateSpace:
    """Inverse of `to_continuous`, ``s = (z - 1) / (z + 1)``; a pole at s = 1 has a counterpart that is not causal."""
    eye, n = np.eye(K.n_states), K.n_states
    if n and np.linalg.cond(eye - K.A) > 1e14:
        raise SynthesisError("H-infinity synthesis: the discrete controller of this level is not causal.")
    solved = np.linalg.solve(eye - K.A, np.hstack([eye + K.A, K.B]))
    output = np.linalg.solve((eye - K.A).T, K.C.T).T
    return StateSpace(solved[:, :n], np.sqrt(2) * solved[:, n:], np.sqrt(2) * output, K.D + K.C @ solved[:, n:], dt)


def scale(plant: GeneralizedPlant) -> GeneralizedPlant:
    """Return the plant for D22 = 0 with states scaled by powers of two: A balanced, B as large as C."""
    p = replace(plant, D22=np.zeros_like(plant.D22))
    size = balanced_size(p.A)
    p = p.transformed(x=(np.diag(1 / size), np.diag(size)))
    inputs, outputs = np.linalg.norm(np.hstack([p.B1, p.B2])), np.linalg.norm(np.vstack([p.C1, p.C2]))
    unit = float(np.exp2(np.round(np.log2(outputs / inputs) / 2))) if inputs > 0 and outputs > 0 else 1.0
    return p.transformed(x=(unit * np.eye(len(size)), np.eye(len(size)) / unit))


def _balancing(p: GeneralizedPlant) -> tuple[Array, Array]:
    """Change of the states that balances the H2 Riccati solutions, and its inverse."""
    method = "H-infinity synthesis, balancing"
    try:
        X = solve_riccati(p.A, p.B2, p.C1.T @ p.C1, p.D12.T @ p.D12, p.C1.T @ p.D12, p.dt, method)
        Y = solve_riccati(p.A.T, p.C2.T, p.B1 @ p.B1.T, p.D21 @ p.D21.T, p.B1 @ p.D21.T, p.dt, method)
        left, right, _ = balancing(_root(Y, p.A, p.B1), _root(X, p.A, p.C1))
    except (SynthesisError, LinAlgError):
        return np.eye(len(p.A)), np.eye(len(p.A))
    return left, right


def _root(M: Array, A: Array, source: Array) -> Array:
    """Square root factor ``M = L L'`` with directions of no weight raised to a small one.

    The identity where M is only rounding.
    """
    values, vectors = np.linalg.eigh(M)
    largest = float(values.max(initial=0.0))
    if largest * max(float(np.linalg.norm(A)), 1.0) <= 1e-9 * float(np.linalg.norm(source)) ** 2:
        return np.eye(len(M))
    return np.asarray(vectors * np.sqrt(np.maximum(values, 1e-8 * largest)))
