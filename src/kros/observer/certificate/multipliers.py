r"""Best multipliers over a grid of frequencies: a convex problem in as many numbers as there are slopes, solved by a barrier.

    minimise g   subject to   F_f(t, g) = diag(t, g I) - sum_j t_j h_fj h_fj' - H_z' H_z > 0   at every frequency f,

with ``h_fj`` the row of H that leads to the slope's input q_j. The set of multipliers that prove stability at all is found first, as the
one for which ``lambda diag(t) > sum_j t_j h_fj h_fj'`` with a lambda below one. Newton's method on batches of small Hermitian matrices.

References
----------
S. Boyd and L. El Ghaoui, "Method of centers for minimizing generalized eigenvalues", Linear Algebra and its Applications 188 (1993) 63-111.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt

Array = npt.NDArray[Any]
_NEWTON = 40
_CENTRES = 40
_ACCURACY = 2e-4
_MOST_FREQUENCIES = 80
_WELL_INSIDE = 0.25
_CUTS = 4
_BINDING = 0.1


def best_multipliers(H: Array, width: int) -> Array | None:
    """Return multipliers for which the gain is close to least, shape (n_p,); None where no multipliers prove stability.

    H are responses from [p, w] to [q, z], shape (f, n_p + n_z, n_p + n_w); `width` is n_p.
    """
    G, some = H[:, :width, :width], _MOST_FREQUENCIES // 2
    largest = [np.argsort(-size)[:some] for size in (np.linalg.norm(H, axis=(1, 2)), _needed(G, _balanced(np.abs(G).max(axis=0))))]
    chosen = np.unique(np.concatenate([*largest, np.linspace(0, len(H) - 1, some).astype(int)]))
    for _ in range(_CUTS):
        t = _best(H[chosen], width)
        if t is None:
            return None
        above = _needed(G, t)
        if above.max() < 1:
            return t
        chosen = np.union1d(chosen, np.argsort(-above)[:some])
    return None


def _best(H: Array, width: int) -> Array | None:
    """Return them for all frequencies that are given."""
    through = np.sqrt(np.max(np.sum(np.abs(H[:, width:, :width]) ** 2, axis=1), axis=0))
    by_slopes = through @ np.sqrt(np.max(np.sum(np.abs(H[:, :width, width:]) ** 2, axis=2), axis=0))
    size = max(np.linalg.norm(H[:, width:, width:], 2, axis=(1, 2)).max(), by_slopes) or 1.0
    through = np.maximum(through, 1e-12 * size)
    H = H / np.concatenate([through, np.full(H.shape[2] - width, size)])
    H[:, :width] *= through[:, None]  # now t is measured in units of through^2
    start = _stabilising(H[:, :width, :width])
    if start is None:
        return None
    rows = np.einsum("fja,fjb->fjab", H[:, :width].conj(), H[:, :width])
    fixed = np.conj(np.swapaxes(H[:, width:], 1, 2)) @ H[:, width:]
    n = H.shape[2]
    units = np.zeros((width + 1, n, n))
    units[range(width), range(width), range(width)] = 1.0
    units[width, range(width, n), range(width, n)] = 1.0
    slopes = np.concatenate([units[:width] - rows, np.broadcast_to(units[width:], (len(H), 1, n, n))], axis=1)
    x = np.append(start, 1.0)
    while not _inside(-fixed[:, :width, :width], slopes[:, :width, :width, :width], x[:width]):
        x[:width] *= 2.0
    while not _inside(-fixed, slopes, x):
        x[width] *= 2.0
    weight = len(H) * n / x[width]
    while weight * x[width] * _ACCURACY < len(H) * n:
        x = _newton(-fixed, slopes, np.append(np.zeros(width), weight), x)
        weight *= 8.0
    return np.asarray(x[:width] * through**2)


def _stabilising(G: Array) -> Array | None:
    """Return multipliers with ``diag(t) > G_f' diag(t) G_f`` at every frequency, well inside; None where there are none."""
    width = G.shape[1]
    rows = np.einsum("fja,fjb->fjab", G.conj(), G)
    units = np.zeros((width, width, width))
    units[range(width), range(width), range(width)] = 1.0
    t = min((np.ones(width), _balanced(np.abs(G).max(axis=0))), key=lambda t: _needed(G, t).max())
    needed = _needed(G, t)
    level, binding = needed.max(), np.zeros(len(G), bool)
    least, best = level, t
    for centred in range(_CENTRES):
        if level < _WELL_INSIDE and centred:
            break
        looser = max(level * 1.05 + 1e-12, _WELL_INSIDE)
        # Frequencies far below the level bind nothing, and as many of them would keep the centre where it is.
        binding, known = binding | (needed > _BINDING * level), binding
        # One number of the t is free: their sum stays below the number of slopes.
        rest = np.zeros((binding.sum() + 1, width, width), complex)
        slopes = np.concatenate([looser * units - rows[binding], -np.broadcast_to(np.eye(width), (1, width, width, width))], axis=0)
        rest[-1] = 2 * width * np.eye(width)
        t = _newton(rest, slopes, np.zeros(width), t * width / t.sum())
        needed, before = _needed(G, t), level
        level = needed.max()
        if level < least:
            least, best = level, t
        if level > 0.999 * before and before >= _WELL_INSIDE and np.array_equal(binding, known):
            break
    return best if least < 1 else None  # where little room is left, the centre at a looser level may be worse than what it began with


def _balanced(size: Array) -> Array:
    """Return multipliers that balance a matrix of sizes, by its Perron vectors; channels may act one way only."""
    size = size + 1e-3 * size.max(initial=1e-300)
    right = left = np.ones(len(size))
    for _ in range(_NEWTON):
        right, left = size @ right, left @ size
        right, left = right / right.sum(), left / left.sum()
    t = left / right
    return np.asarray(t * len(t) / t.sum())


def _needed(G: Array, t: Array) -> Array:
    """Return the least lambda for given multipliers, at every frequency."""
    root = np.sqrt(t)
    return np.asarray(np.linalg.norm(root[:, None] * G / root, 2, axis=(1, 2)) ** 2)


def _inside(fixed: Array, slopes: Array, x: Array) -> bool:
    return bool(np.linalg.eigvalsh(fixed + np.tensordot(x, slopes, (0, 1)))[:, 0].min() > 0)


def _newton(fixed: Array, slopes: Array, cost: Array, x: Array) -> Array:
    """Minimise ``cost x - sum_f log det (fixed_f + sum_i x_i slopes_fi)`` from a point inside."""

    def value(x: Array) -> float:
        try:
            R = np.linalg.cholesky(fixed + np.tensordot(x, slopes, (0, 1)))
        except np.linalg.LinAlgError:
            return np.inf
        return float(cost @ x - 2 * np.log(np.einsum("fii->fi", R).real).sum())

    current = value(x)
    for _ in range(_NEWTON):
        F = fixed + np.tensordot(x, slopes, (0, 1))
        parts = np.linalg.inv(F)[:, None] @ slopes
        gradient = cost - np.trace(parts, axis1=2, axis2=3).real.sum(axis=0)
        hessian = np.einsum("fiab,fjba->ij", parts, parts, optimize=True).real
        step = -np.linalg.lstsq(hessian, gradient, rcond=None)[0]
        decrease = -float(gradient @ step)
        if decrease < 1e-4:
            break
        length = 1.0
        while (trial := value(x + length * step)) > current - 0.1 * length * decrease and length > 1e-8:
            length /= 2
        if length <= 1e-8:
            break
        x, current = x + length * step, trial
    return x
