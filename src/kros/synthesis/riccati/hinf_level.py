r"""One level of the H-infinity problem: necessary and sufficient conditions, and the central controller.

The level is solved in continuous time, for a normalised plant, ``D12 = [0; I]``, ``D21 = [0, I]``, ``D22 = 0``.
Discrete plants go through ``z = (1 + s) / (1 - s)``, which maps the unit circle to the imaginary axis and keeps all
gains, so that nothing is approximated. A controller with ``||T|| < gamma`` exists exactly when the direct gain leaves
room (Parrott), both Riccati equations have stabilising solutions, these are positive semidefinite, and ``rho(X Y) <
gamma^2``.

Symbols
-------
X, Y : stabilising solutions of control and filter, (n, n)
F = [F11; F12; F2] : state feedback, rows of the free disturbances, the measured ones, the control
L = [L11, L12, L2] : output injection, columns of the free outputs, the penalised ones, the measurements
E = I - Y X / gamma^2 : coupling; its inverse is Z of the source, and is never formed

References
----------
K. Zhou, J. C. Doyle, K. Glover, *Robust and Optimal Control*, theorem 17.1 (page 442).
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.linalg import LinAlgError, cond, eigh, eigvalsh, norm, svd

from ...core import EPS, SINGULAR, TINY, AnyArray, StateSpace, SynthesisError, frozen, gain
from ...core.linalg import balanced_size, spectral_radius
from ...core.norms import to_continuous
from ..generalized_plant import GeneralizedPlant, split
from .h2 import absorb_feedthrough, balancing, riccati_pair

_DOUBT = float(np.sqrt(EPS))  # relative: conditions that hold or fail by less than this decide nothing


@frozen
class Frame:
    """The normalised continuous plant, and the way back to controllers of the plant as it was given."""

    given: GeneralizedPlant
    scaled: GeneralizedPlant  # the given plant for D22 = 0, its states scaled by powers of two
    D22: AnyArray
    normal: GeneralizedPlant
    left: AnyArray
    right: AnyArray

    @classmethod
    def of(cls, given: GeneralizedPlant) -> Frame:
        """Scale, map and normalise a regular plant."""
        n, n_w, n_u, n_z, n_y = given.sizes
        scaled = scale(given)
        X, Y = riccati_pair(scaled, "H-infinity synthesis, balancing")  # in coordinates that balance these
        x = balancing(_root(Y, _size(scaled.A, scaled.B1)), _root(X, _size(scaled.A, scaled.C1)))[:2]
        p = scaled.transformed(x=x)
        if given.dt > 0:
            if n and cond(p.A + np.eye(n)) > SINGULAR:
                pole = "the plant has a pole at z = -1, which no bilinear map takes to continuous time"
                raise SynthesisError(f"H-infinity synthesis: {pole}; move it into the stable region.")
            p = split(to_continuous(p.open_loop()), n_w, n_z)
        U, s, Vh = svd(p.D12)
        V, t, Wh = svd(p.D21)
        left, right = Vh.T / s, V.T / t[:, None]
        normal = replace(
            p.transformed(z=np.roll(U, -n_u, axis=1).T, w=np.roll(Wh, -n_y, axis=0).T, y=right, u=left),
            D12=np.eye(n_z)[:, n_z - n_u :],
            D21=np.eye(n_w)[n_w - n_y :],
            D22=np.zeros((n_y, n_u)),
        )
        return cls(given, scaled, p.D22, normal, left, right)

    def solve(self, gamma: float) -> tuple[StateSpace | None, bool]:
        """Return the central controller of a level, if there is one, and whether its conditions clearly fail."""
        p = self.normal
        try:
            X, F = _half(p, gamma)
            Y, L = _half(p.dual, gamma)
            radius = float(spectral_radius(Y @ X)) / gamma**2
            if min(_lowest(X, _size(p.A, p.C1)), _lowest(Y, _size(p.A, p.B1))) < -_DOUBT or radius > 1 + _DOUBT:
                return None, True
            return (self._given(_central(p, gamma, X, F, Y, L.T)), False) if radius < 1 else (None, False)
        except (LinAlgError, SynthesisError):
            return None, False

    def _given(self, K: StateSpace) -> StateSpace:
        """Controller of the given plant for one of the normalised plant."""
        K = gain(self.left, 0.0) @ K @ gain(self.right, 0.0)
        K = _to_discrete(K, self.given.dt) if self.given.dt > 0 else K
        # In discrete time: for a controller with a pole at z = -1 the continuous loop would have no solution.
        return absorb_feedthrough(absorb_feedthrough(K, self.D22), self.given.D22)


def _half(p: GeneralizedPlant, gamma: float) -> tuple[AnyArray, AnyArray]:
    """Stabilising solution X of ``x' = A x + B1 w + B2 u``, cost ``z'z - gamma^2 w'w``, and its feedback of (w, u)."""
    from scipy.linalg import schur

    A, B, C, D = p.A, np.hstack([p.B1, p.B2]), p.C1, np.hstack([p.D11, p.D12])
    n, n_w, *_ = p.sizes
    R = D.T @ D - gamma**2 * np.diag(np.arange(D.shape[1]) < n_w)
    solved = np.linalg.solve(R, np.hstack([D.T @ C, B.T]))
    closed, quadratic, cost = A - B @ solved[:, :n], B @ solved[:, n:], C.T @ C - C.T @ D @ solved[:, :n]
    # Units of the costate level the blocks: rounding is relative to both.
    unit = np.sqrt(norm(cost) / norm(quadratic)) if cost.any() and quadratic.any() else 1.0
    H = np.block([[closed, -unit * (quadratic + quadratic.T) / 2], [-(cost + cost.T) / (2 * unit), -closed.T]])
    _, basis, stable = schur(H, output="real", sort="lhp")
    if stable != n:
        raise SynthesisError("H-infinity synthesis: the Hamiltonian matrix has eigenvalues on the imaginary axis.")
    X = unit * np.linalg.solve(basis[:n, :n].T, basis[n:, :n].T)
    return (X + X.T) / 2, -solved[:, :n] - solved[:, n:] @ X


def _lowest(X: AnyArray, size: float) -> float:
    """Lowest eigenvalue over the largest magnitude, which is at least a size."""
    values = eigvalsh(X)
    return float(values.min(initial=0.0) / max(float(np.abs(values).max(initial=0.0)), size, TINY))


def _central(p: GeneralizedPlant, gamma: float, X: AnyArray, F: AnyArray, Y: AnyArray, L: AnyArray) -> StateSpace:
    """Central controller of the normalised plant (Zhou, Doyle and Glover, theorem 17.1)."""
    _, n_w, n_u, n_z, n_y = p.sizes
    free_z, free_w = n_z - n_u, n_w - n_y
    (D1111, D1112), (D1121, D1122) = (np.split(rows, [free_w], axis=1) for rows in np.split(p.D11, [free_z]))
    D = -D1121 @ D1111.T @ np.linalg.solve(gamma**2 * np.eye(free_z) - D1111 @ D1111.T, D1112) - D1122
    innovation = p.C2 + F[free_w:n_w]
    E = np.eye(len(X)) - Y @ X / gamma**2
    solved = np.linalg.solve(E, (p.B2 + L[:, free_z:n_z]) @ D - L[:, n_z:])
    A = p.A + p.B1 @ F[:n_w] + p.B2 @ F[n_w:] - solved @ innovation
    return StateSpace(A, solved, F[n_w:] - D @ innovation, D, 0.0)


def _to_discrete(K: StateSpace, dt: float) -> StateSpace:
    """Inverse of `to_continuous`, ``s = (z - 1) / (z + 1)``; a pole at s = 1 has a counterpart that is not causal."""
    eye, n = np.eye(K.n_states), K.n_states
    if n and cond(eye - K.A) > SINGULAR:
        raise SynthesisError("H-infinity synthesis: the discrete controller of this level is not causal.")
    solved = np.linalg.solve(eye - K.A, np.hstack([eye + K.A, K.B]))
    output = np.linalg.solve((eye - K.A).T, K.C.T).T
    return StateSpace(solved[:, :n], np.sqrt(2) * solved[:, n:], np.sqrt(2) * output, K.D + K.C @ solved[:, n:], dt)


def scale(plant: GeneralizedPlant) -> GeneralizedPlant:
    """Return the plant for D22 = 0 with states scaled by powers of two that balance ``[[A, |B|], [|C|, 0]]``."""
    p = replace(plant, D22=np.zeros_like(plant.D22))
    inputs = norm(np.hstack([p.B1, p.B2]), axis=1)[:, None]
    outputs = norm(np.vstack([p.C1, p.C2]), axis=0)[None]
    sizes = balanced_size(np.block([[p.A, inputs], [outputs, np.zeros((1, 1))]]))
    size = sizes[:-1] / sizes[-1]
    return p.transformed(x=(np.diag(1 / size), np.diag(size)))


def _root(M: AnyArray, size: float) -> AnyArray:
    """Factor L of ``M = L L'``, in which directions without weight have a small one; the identity for rounding."""
    values, vectors = eigh(M)
    largest = float(values.max(initial=0.0))
    return vectors * np.sqrt(np.maximum(values, _DOUBT * largest)) if largest > _DOUBT * size else np.eye(len(M))


def _size(A: AnyArray, B: AnyArray) -> float:
    """Size of a Riccati solution to expect for dynamics A and inputs or outputs B."""
    return float(norm(B)) ** 2 / max(float(norm(A)), TINY)
