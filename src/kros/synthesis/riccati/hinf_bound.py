r"""Lower bounds of the H-infinity problem from signals on which no controller has an influence.

*At one frequency* (Parrott's theorem): the signals ``(s I - A) x = B w, C_y x + D_y w = 0`` reach z whatever the
controller does, so that
``||T|| >= |C x + D w| / |w|``, and alike for the transposed plant.

*In time*::

    t < 0:  w = w_p with y = 0 and u = 0, so that every controller is at rest and the state reaches x0
    t >= 0: outputs weighted by zeta, orthogonal to whatever u does, which see x0 as p0' x0

With ``z_p`` the outputs of the past and ``g`` the adjoint's response to zeta (both are the same for every controller),

.. math:: \|T\|^2 \ge \gamma^2 \quad\text{where}\quad
    \gamma^2 \|w_p\|^2 - \|z_p\|^2 + \|\zeta\|^2 - \|g\|^2 / \gamma^2 \le 2\, p_0^T x_0

The signals come from the Hamiltonian matrices of a level, but they prove the bound whatever they come from: constraints
and energies are evaluated in the coordinates of the plant as it was given, and errors of a level enter squared. No
decision rests on an eigenvalue being on the boundary.

Symbols
-------
x = V c : states of the past (or, for the transposed plant, the adjoint states of the future), shape (n, r)
M, G : ``c(k) = M c(k+1)``, ``w(k) = G c(k+1)``; in continuous time ``dc/dtau = M c``, ``w = G c`` with tau = -t
W, Z : energies of w and z as quadratic forms of c(0)

References
----------
K. Zhou, J. C. Doyle, K. Glover, *Robust and Optimal Control*, section 16.8 (the mixed Hankel-Toeplitz operator).
"""

from __future__ import annotations

import warnings
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt
from scipy.linalg import LinAlgError, block_diag, null_space, schur

from ...core.linalg import adjoint
from ...core.norms import first_frequencies, gramian
from ..generalized_plant import GeneralizedPlant
from .hinf_level import Frame, Half

Array = npt.NDArray[Any]

_EPS = float(np.finfo(float).eps)
_RANK = 1e-9  # of direct gains and of kernels, relative: signals smaller than this prove nothing
_CUTS = (1e-9, 1e-3)  # relative size below which directions of the state are left out; the others prove a bound
_REACHED = 1e-10  # new directions below this share are not reached
_SINGULAR = 1e-12  # of constraints, relative: an input that states of the signals can replace
_NEAR = 1e-2  # distance from the boundary, relative, of eigenvalues whose frequencies are tried
_MARGIN = 1e-9  # constraints hold to rounding, not exactly


@dataclass(frozen=True, eq=False)
class Side:
    """The signals w of ``x+ = A x + B w`` that keep ``C_y x + D_y w`` at zero, and their outputs ``z = C x + D w``."""

    A: Array
    B: Array
    C: Array
    D: Array
    C_y: Array
    D_y: Array
    dt: float

    @classmethod
    def both(cls, p: GeneralizedPlant) -> tuple[Side, Side]:
        """Return the side of the outputs, which is that of the transposed plant, and the side of the disturbances."""
        future = cls(p.A.T, p.C1.T, p.B1.T, p.D11.T, p.B2.T, p.D12.T, p.dt)
        return future, cls(p.A, p.B1, p.C1, p.D11, p.C2, p.D21, p.dt)

    def at_infinity(self) -> float:
        """Return the bound at ``s = infinity``, where the kernel is that of D_y."""
        _, values, Vh = np.linalg.svd(self.D_y) if self.D_y.size else (None, np.zeros(0), np.eye(self.B.shape[1]))
        free = Vh[int(np.sum(values > _RANK * values.max(initial=0.0))) :].T
        return float(np.linalg.norm(self.D @ free, 2)) if self.D.size and free.size else 0.0

    def at(self, rad: Array) -> Array:
        """Return the bounds at frequencies, rad/s, in discrete time rad per sample."""
        n, m, q = len(self.A), self.B.shape[1], len(self.C_y)
        if not m or not len(self.C):
            return np.zeros(len(rad))
        # zeta = z - 1 keeps the digits at low frequency, where z and A are both close to one.
        point = np.expm1(1j * rad) if self.dt > 0 else 1j * rad
        shifted = self.A - np.eye(n) if self.dt > 0 else self.A
        system = np.zeros((len(rad), n + q, n + m), complex)
        system[:, :n, :n] = point[:, None, None] * np.eye(n) - shifted
        system[:, :n, n:], system[:, n:, :n], system[:, n:, n:] = -self.B, self.C_y, self.D_y
        size = np.linalg.norm(system, axis=2, keepdims=True)
        _, values, Vh = np.linalg.svd(system / np.where(size > 0, size, 1.0))
        # Constraints that only rounding tells from others are none: without an effect of K on z the kernel is larger.
        free = np.ones((len(rad), n + m), bool)
        free[:, : values.shape[1]] = values <= 10 * (n + m) * _EPS * values[:, :1]
        kernel = adjoint(Vh) * free[:, None, :]
        # Combinations of the kernel with w = 0 prove nothing; those with next to none only as much as rounding leaves.
        _, values, Vh = np.linalg.svd(kernel[:, n:])
        inverse = np.where(values > _RANK, 1 / np.maximum(values, _RANK), 0.0)
        signals = kernel @ adjoint(Vh[:, : values.shape[1]]) * inverse[:, None, :]
        bounds = np.linalg.norm(self.C @ signals[:, :n] + self.D @ signals[:, n:], 2, axis=(-2, -1))
        return np.asarray(bounds * (1 - 100 * (n + m) * _EPS * np.maximum(inverse.max(axis=1), 1.0)))


def _reachable(side: Side) -> Array:
    """Orthonormal basis of the states without the stable modes that no signal reaches, which would grow backwards."""
    n, F, N = len(side.A), np.zeros((side.B.shape[1], len(side.A))), np.eye(side.B.shape[1])
    if side.D_y.size:  # w = F x + N v keeps the constraint, for a full-rank D_y
        U, s, Vh = np.linalg.svd(side.D_y)
        r = int(np.sum(s > 1e-12 * s.max(initial=0.0)))
        F, N = -Vh[:r].T @ ((U[:, :r].T @ side.C_y) / s[:r, None]), Vh[r:].T
    A, new = side.A + side.B @ F, side.B @ N
    basis, new = np.zeros((n, 0)), new / max(float(np.linalg.norm(new)), 1e-300)
    while new.size and basis.shape[1] < n:
        U, s, _ = np.linalg.svd(new - basis @ (basis.T @ new), full_matrices=False)
        new = np.linalg.qr(U[:, s > _REACHED] - basis @ (basis.T @ U[:, s > _REACHED]))[0]
        basis, new = np.hstack([basis, new]), A @ new / max(float(np.linalg.norm(A)), 1e-300)
    left = null_space(basis.T) if basis.shape[1] else np.eye(n)
    if not left.shape[1]:
        return np.eye(n)
    _, L, k = schur((left.T @ A @ left).T, output="real", sort="iuc" if side.dt > 0 else "lhp")
    return np.asarray(null_space((left @ L[:, :k]).T) if k else np.eye(n))


def pointwise_bound(p: GeneralizedPlant, rad: Array | None = None) -> float:
    """Return the largest Parrott bound over frequencies, by default around all poles, less its rounding."""
    best = max(side.at_infinity() for side in Side.both(p))
    if not len(p.A) or (rad is not None and not len(rad)):
        return best * (1 - _MARGIN)
    for side in Side.both(p):
        points = _grid(p) if rad is None else np.unique(rad)
        for _ in range(5):
            bounds = side.at(points)
            k = int(np.argmax(bounds))
            best = max(best, float(bounds[k]))
            points = np.linspace(points[max(k - 1, 0)], points[min(k + 1, len(points) - 1)], 9)
            if points[0] == points[-1] or bounds[k] == 0:
                break
    return best * (1 - _MARGIN)


def _grid(p: GeneralizedPlant) -> Array:
    """Frequencies of a first look, rad/s or rad per sample."""
    poles = np.linalg.eigvals(p.A)
    if p.dt == 0:
        return first_frequencies(poles)
    mapped = (poles - 1) / np.where(np.abs(poles + 1) > _EPS, poles + 1, _EPS)
    return np.append(2 * np.arctan(first_frequencies(mapped)), np.pi)


def level_bound(frame: Frame, halves: tuple[Half, Half]) -> float:
    """Return the largest norm that the signals of a level's Hamiltonian matrices prove to be out of reach."""
    values = np.concatenate([half.eigenvalues for half in halves])
    best = pointwise_bound(frame.scaled, _candidates(values, frame.given.dt > 0))
    if not len(frame.scaled.A):
        return best
    future, past = Side.both(frame.scaled)
    after = _families(future, halves[0], frame.T.T, frame.outputs.T)
    before = _families(past, halves[1], frame.back, frame.inputs)
    return max([best, *(coupled(a, b) * (1 - _MARGIN) for a in after for b in before)])


def _candidates(eigenvalues: Array, discrete: bool) -> Array:
    """Frequencies of eigenvalues near the boundary, and the points between them."""
    s = eigenvalues[(np.abs(eigenvalues.real) <= _NEAR * np.abs(eigenvalues)) & (eigenvalues.imag >= 0)].imag
    near = 2 * np.arctan(s) if discrete else s
    if not near.size:
        return near
    points = np.unique(np.append(near, 0.0))
    return np.unique(np.concatenate([points, (points[1:] + points[:-1]) / 2, np.sqrt(points[1:] * points[:-1])]))


@dataclass(frozen=True, eq=False)
class Signals:
    """A family of signals of one side.

    Energies W and Z, and bounds `of_w`, `of_z` of their rounding errors, all as quadratic forms of c(0).
    """

    V: Array
    W: Array
    Z: Array
    of_w: Array
    of_z: Array


def _families(side: Side, half: Half, states: Array, inputs: Array) -> list[Signals]:
    """Return no signals, and those of a Hamiltonian matrix in the plant's coordinates, for several cuts."""
    families = [Signals(np.zeros((len(side.A), 0)), *(np.zeros((0, 0)) for _ in range(4)))]
    if half.P is None or half.M is None or half.Z is None:
        return families
    M, G = half.M, inputs @ half.Z
    if side.dt > 0:
        inverse = np.linalg.inv(np.eye(len(M)) - M)
        M, G = (np.eye(len(M)) + M) @ inverse, np.sqrt(2) * G @ inverse
    basis = _reachable(side)
    U, s, Wt = np.linalg.svd(basis @ (basis.T @ states @ half.P))
    for r in {int(np.sum(s > cut * s[0])) for cut in _CUTS if s[0] > 0}:
        # Signals that reach no state are none, so what is left of them moves by itself.
        for unit in (s[:r], s[:1]):  # signals of states of one size, and as the matrix has them
            back = Wt[:r].T / unit
            signals = evaluated(side, U[:, :r] * (s[:r] / unit), (unit[:, None] * Wt[:r]) @ M @ back, G @ back)
            families += [] if signals is None else [signals]
    return families


def evaluated(side: Side, V: Array, M: Array, G: Array) -> Signals | None:
    """Make the signals satisfy the constraints and return their energies; None where that fails."""
    r, q = V.shape[1], len(side.C_y)
    zero = np.zeros((q, r))
    if side.dt > 0:
        J, target = np.block([[side.A @ V, side.B], [side.C_y @ V, side.D_y]]), np.vstack([V, zero])
    else:
        J, target = np.block([[V, side.B], [zero, side.D_y]]), -np.vstack([side.A @ V, side.C_y @ V])
    both = np.vstack([M, G])
    rows = np.linalg.norm(np.block([[side.A, side.B], [side.C_y, side.D_y]]), axis=1)[:, None]
    size = np.where(rows > 0, rows, 1.0)
    for _ in range(2):
        both = both + np.linalg.lstsq(J / size, (target - J @ both) / size, rcond=_SINGULAR)[0]
    if not np.isfinite(both).all():
        return None
    M, G = both[:r], both[r:]
    # What is left is that of a plant whose rows differ by rounding.
    columns = np.linalg.norm(np.vstack([V @ M if side.dt > 0 else V, G]), axis=0)
    moved = np.vstack([np.abs(V) if side.dt > 0 else np.abs(V) @ np.abs(M), zero])
    if np.any(np.abs(target - J @ both) > 100 * _EPS * len(J) * (rows * columns + moved)):
        return None
    out = side.C @ V @ M + side.D @ G if side.dt > 0 else side.C @ V + side.D @ G
    first = _energies(V, M, G, out, side.dt)
    if first is None:
        return None
    # Again in units in which the signals have energies of about one, so that errors are small beside all of them.
    values, vectors = np.linalg.eigh(first.W)
    root = np.sqrt(np.maximum(values, 1e-14 * values[-1]))
    unit, back = vectors / root, (vectors * root).T
    return _energies(V @ unit, back @ M @ unit, G @ unit, out @ unit, side.dt)


def _energies(V: Array, M: Array, G: Array, out: Array, dt: float) -> Signals | None:
    """Gramians with the bound of their errors.

    A residual R changes a Gramian by at most ``||R||`` times that of the identity.
    """
    eye = np.eye(len(M))
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("error", RuntimeWarning)  # overflow, or an equation that was perturbed to be solved
            unit, W, Z = (gramian(M.T, F.T, dt) for F in (eye, G, out))
    except (LinAlgError, ValueError, RuntimeWarning):
        return None
    if not all(np.isfinite(X).all() for X in (unit, W, Z)) or np.linalg.eigvalsh(unit)[0] <= 0:
        return None
    # A positive definite Gramian of the identity with a residual below one half proves that the signals decay.
    if _residual(M, eye, unit, dt) >= 0.5:
        return None
    return Signals(V, W, Z, 2 * _residual(M, G, W, dt) * unit, 2 * _residual(M, out, Z, dt) * unit)


def _residual(M: Array, F: Array, X: Array, dt: float) -> float:
    rest = M.T @ X @ M + F.T @ F - X if dt > 0 else M.T @ X + X @ M + F.T @ F
    power = np.linalg.norm(M) ** 2 + 1 if dt > 0 else 2 * np.linalg.norm(M)
    return float(np.linalg.norm(rest) + 4 * len(M) * _EPS * (power * np.linalg.norm(X) + np.linalg.norm(F) ** 2))


def coupled(future: Signals, past: Signals) -> float:
    """Return the largest norm that signals of the two families prove, less its rounding."""
    r = past.V.shape[1]
    if not r + future.V.shape[1]:
        return 0.0
    cross = np.zeros((r + future.V.shape[1],) * 2)
    cross[:r, r:] = past.V.T @ future.V
    cross[r:, :r] = cross[:r, r:].T
    rounding = 10 * len(past.V) * _EPS * np.abs(past.V).T @ np.abs(future.V)
    W = block_diag(past.W + past.of_w, future.W + future.of_w)
    Z = block_diag(past.Z - past.of_z, future.Z - future.of_z)
    root = block_diag(_unit_energy(W[:r, :r]), _unit_energy(W[r:, r:]))
    if not root.shape[1]:
        return 0.0
    best = 0.0
    for _ in range(30):
        # The signals that are worst at the level that is proven prove a higher one (a Rayleigh quotient).
        form = cross if cross.any() else Z
        if best > 0:
            form = cross + Z / best
        c = root @ np.linalg.eigh(root.T @ form @ root)[1][:, -1]
        c *= np.sign(c @ cross @ c) or 1.0
        inner = max(float(c @ cross @ c / 2 - np.abs(c[:r]) @ rounding @ np.abs(c[r:])), 0.0)
        w, z = float(c @ W @ c), float(c @ Z @ c)
        value = (inner + float(np.sqrt(max(inner**2 + w * z, 0.0)))) / w  # where w gamma - z / gamma = 2 inner
        if value <= best * (1 + 1e-13):
            break
        best = value
    return best


def _unit_energy(W: Array) -> Array:
    """Orthogonal signals of unit energy, without those that have none: states that nothing reaches."""
    values, vectors = np.linalg.eigh(W)
    usable = values > 1e-14 * values.max(initial=0.0)
    return np.asarray(vectors[:, usable] / np.sqrt(values[usable]))
