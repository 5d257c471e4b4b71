r"""Lower bounds of the H-infinity problem at single frequencies: Parrott's theorem, without the inverse of anything that may be singular.

At a point s of the boundary the signals ``(s I - A) x = B w, C_y x + D_y w = 0`` reach z whatever the controller does, so that

.. math:: \|T\|_\infty \ge \max_{(x, w)} |C x + D w| / |w|,

and alike for the transposed plant. The kernel is computed by singular values, which is exact for a plant within rounding of the one that is given, on
and next to its poles as well. At ``s = infinity`` the kernel is that of D_y.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt

from ...core.linalg import adjoint
from ..generalized_plant import GeneralizedPlant
from .hinf_pencil import Side

Array = npt.NDArray[Any]

_EPS = float(np.finfo(float).eps)
_RANK = 1e-9
_LIGHT = 0.3
_ROUNDS, _POINTS = 5, 9


def direct_bound(p: GeneralizedPlant) -> float:
    """Return the smallest norm of ``D11 + D12 K D21`` over all gains K (Parrott): that of every closed loop at infinity."""
    return max(_at_infinity(s) for s in Side.both(p))


def pointwise_bound(p: GeneralizedPlant, rad: Array) -> float:
    """Return the largest Parrott bound over frequencies, shape (f,), rad/s, in discrete time rad per sample, and around the best of them."""
    if not len(p.A):
        return direct_bound(p)
    best = 0.0
    for s in Side.both(p):
        points = np.unique(rad)
        for _ in range(_ROUNDS):
            found = _at(s, points)
            k = int(np.argmax(found))
            best = max(best, float(found[k]))
            points = np.linspace(points[max(k - 1, 0)], points[min(k + 1, len(points) - 1)], _POINTS)
            if points[0] == points[-1] or found[k] == 0:
                break
    return best


def resonances(A: Array, discrete: bool) -> Array:
    """Frequencies where lightly damped poles of A let a system peak, and both sides of them; rad/s or rad per sample."""
    poles = np.linalg.eigvals(A).astype(complex) if A.size else np.zeros(0, complex)
    if discrete:
        poles = np.log(poles[np.abs(poles) > 0])
    poles = poles[(poles.imag >= 0) & (np.abs(poles.real) < _LIGHT * np.abs(poles))]
    # A pole a + jb peaks at sqrt(b^2 - a^2) in the transfer function of second order.
    peaks = np.sqrt(np.maximum(poles.imag**2 - poles.real**2, 0.0))
    beside = poles.imag[:, None] + np.abs(poles.real)[:, None] * np.array([-3.0, -1.0, 0.0, 1.0, 3.0])
    return np.unique(np.clip(np.concatenate([beside.ravel(), peaks]), 0.0, np.pi if discrete else np.inf))


def _at_infinity(s: Side) -> float:
    _, values, Vh = np.linalg.svd(s.D_y) if s.D_y.size else (None, np.zeros(0), np.eye(s.B.shape[1]))
    free = Vh[int(np.sum(values > _RANK * values.max(initial=0.0))) :].T
    return float(np.linalg.norm(s.D @ free, 2)) if s.D.size and free.size else 0.0


def _at(s: Side, rad: Array) -> Array:
    n, m, q = len(s.A), s.B.shape[1], len(s.C_y)
    if not m or not len(s.C):
        return np.zeros(len(rad))
    # zeta = z - 1 keeps the digits at low frequency, where z and A are both close to one.
    point = np.expm1(1j * rad) if s.dt > 0 else 1j * rad
    shifted = s.A - np.eye(n) if s.dt > 0 else s.A
    system = np.zeros((len(rad), n + q, n + m), complex)
    system[:, :n, :n] = point[:, None, None] * np.eye(n) - shifted
    system[:, :n, n:], system[:, n:, :n], system[:, n:, n:] = -s.B, s.C_y, s.D_y
    size = np.linalg.norm(system, axis=2, keepdims=True)
    _, values, Vh = np.linalg.svd(system / np.where(size > 0, size, 1.0))
    # Constraints that only rounding tells from others are none: where K has no effect on z the kernel is larger than sizes say.
    free = np.ones((len(rad), n + m), bool)
    free[:, : values.shape[1]] = values <= 10 * (n + m) * _EPS * values[:, :1]
    kernel = adjoint(Vh) * free[:, None, :]
    # Combinations of the kernel with w = 0 prove nothing; those with next to none only as much as rounding leaves.
    _, values, Vh = np.linalg.svd(kernel[:, n:])
    kept = values > _RANK
    k = values.shape[1]
    signals = kernel @ adjoint(Vh[:, :k]) * np.where(kept, 1 / np.where(kept, values, 1.0), 0.0)[:, None, :]
    found = np.linalg.norm(s.C @ signals[:, :n] + s.D @ signals[:, n:], 2, axis=(-2, -1))
    return np.asarray(found * (1 - 100 * (n + m) * _EPS / np.where(kept, values, 1.0).min(axis=1)))
