r"""Lower bounds of the H-infinity problem at single frequencies (Parrott's theorem).

Signals ``(s I - A) x = B w, C_y x + D_y w = 0`` reach z whatever the controller does, so that ``||T|| >= |C x + D w| /
|w|``, and alike for the transposed plant. For a regular plant and a level above the bounds of all frequencies, both
Riccati equations of `hinf_level` have stabilising solutions.
"""

from __future__ import annotations

import numpy as np
from scipy.linalg import null_space

from ...core.arrays import AnyArray
from ...core.linalg import adjoint
from ...core.norms import first_frequencies
from ...core.rounding import EPS
from ..generalized_plant import GeneralizedPlant

_RANK = float(np.sqrt(EPS))  # relative: signals that are smaller prove nothing


def frequency_bound(p: GeneralizedPlant) -> float:
    """Return the largest bound of the frequencies around all poles, refined around the largest some rounds."""
    sides = (p.A, p.B1, p.C1, p.D11, p.C2, p.D21), (p.A.T, p.C1.T, p.B1.T, p.D11.T, p.B2.T, p.D12.T)
    best = 0.0
    for side in sides:
        A, _, _, D, _, D_y = side
        free = null_space(D_y)
        best = max(best, float(np.linalg.norm(D @ free, 2)) if D.size and free.size else 0.0)
        points = _grid(A, p.dt) if len(A) and D.size else np.zeros(0)
        for _ in range(5 if points.size else 0):  # rounds; the bound is proven after any of them
            bounds = _bounds(side, points, p.dt)
            k = int(np.argmax(bounds))
            best = max(best, float(bounds[k]))
            points = np.linspace(points[max(k - 1, 0)], points[min(k + 1, len(points) - 1)], 9)
    return best


def _bounds(side: tuple[AnyArray, ...], rad: AnyArray, dt: float) -> AnyArray:
    """Return the bounds at frequencies, rad/s, in discrete time rad per sample."""
    A, B, C, D, C_y, D_y = side
    n, m, q = len(A), B.shape[1], len(C_y)
    # z - 1 keeps the digits at low frequency, where z and A are both close to one.
    point, shifted = (np.expm1(1j * rad), A - np.eye(n)) if dt > 0 else (1j * rad, A)
    system = np.zeros((len(rad), n + q, n + m), complex)
    system[:, :n, :n] = point[:, None, None] * np.eye(n) - shifted
    system[:, :n, n:], system[:, n:, :n], system[:, n:, n:] = -B, C_y, D_y
    size = np.linalg.norm(system, axis=2, keepdims=True)
    _, values, Vh = np.linalg.svd(system / np.where(size > 0, size, 1.0))
    # Constraints that only rounding tells from others are none: without an effect of K on z the kernel is larger.
    free = np.ones((len(rad), n + m), bool)
    free[:, : values.shape[1]] = values <= 10 * (n + m) * EPS * values[:, :1]
    kernel = adjoint(Vh) * free[:, None, :]
    # Combinations of the kernel with next to no w prove only as much as rounding leaves.
    _, values, Vh = np.linalg.svd(kernel[:, n:])
    inverse = np.where(values > _RANK, 1 / np.maximum(values, _RANK), 0.0)
    signals = kernel @ adjoint(Vh[:, : values.shape[1]]) * inverse[:, None, :]
    bounds = np.linalg.norm(C @ signals[:, :n] + D @ signals[:, n:], 2, axis=(-2, -1))
    return bounds * (1 - 100 * (n + m) * EPS * np.maximum(inverse.max(axis=1), 1.0))


def _grid(A: AnyArray, dt: float) -> AnyArray:
    """Frequencies of a first look, rad/s or rad per sample."""
    poles = np.linalg.eigvals(A)
    if dt == 0:
        return first_frequencies(poles)
    mapped = (poles - 1) / np.where(np.abs(poles + 1) > EPS, poles + 1, EPS)
    return np.append(2 * np.arctan(first_frequencies(mapped)), np.pi)
