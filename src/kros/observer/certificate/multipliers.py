r"""Best multipliers over a grid of frequencies: a convex problem, solved by a barrier.

    minimise g   subject to   F_f(t, g) = diag(t, g I) - sum_j t_j h_fj h_fj' - H_z' H_z > 0   at every frequency f,

with ``h_fj`` the row of H that leads to the slope's input q_j. The set of multipliers that prove stability at all is
found first, as the one for which ``lambda diag(t) > sum_j t_j h_fj h_fj'`` with a lambda below one. Newton's method on
batches of small Hermitian matrices: whatever the number of disturbances, of two rows for every slope.

References
----------
S. Boyd and L. El Ghaoui, "Method of centers for minimizing generalized eigenvalues", Linear Algebra and its
Applications 188 (1993) 63-111.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
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
    """Return multipliers, (n_p,), for which the gain is close to least; None where none prove stability."""
    G, some = H[:, :width, :width], _MOST_FREQUENCIES // 2
    largest = [
        np.argsort(-size)[:some]
        for size in (np.linalg.norm(H, axis=(1, 2)), _needed(G, _balanced(np.abs(G).max(axis=0))))
    ]
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
    direct = np.linalg.eigh(_adjoint(H[:, width:, width:]) @ H[:, width:, width:])
    size = max(np.sqrt(direct.eigenvalues.max(initial=0.0)), by_slopes) or 1.0
    through = np.maximum(through, 1e-12 * size)
    H = H / np.concatenate([through, np.full(H.shape[2] - width, size)])
    H[:, :width] *= through[:, None]  # now t is measured in units of through^2
    start = _stabilising(H[:, :width, :width])
    if start is None:
        return None
    barrier = _Barrier.of(H, width, direct.eigenvalues / size**2, direct.eigenvectors)
    x = np.append(start, 1.0)
    while barrier.of_slopes().at(x[:width]) is None:
        x[:width] *= 2.0
    while barrier.at(x) is None:
        x[width] *= 2.0
    count = len(H) * H.shape[2]
    weight = count / x[width]
    while weight * x[width] * _ACCURACY < count:
        x = _newton(barrier, np.append(np.zeros(width), weight), x)
        weight *= 8.0
    return np.asarray(x[:width] * through**2)


def _stabilising(G: Array) -> Array | None:
    """Return multipliers with ``diag(t) > G_f' diag(t) G_f`` at every frequency, well inside, or None."""
    width = G.shape[1]
    t = min((np.ones(width), _balanced(np.abs(G).max(axis=0))), key=lambda t: _needed(G, t).max())
    needed = _needed(G, t)
    level, binding = needed.max(), np.zeros(len(G), bool)
    least, best = level, t
    whole = _Barrier.of(G, width, np.zeros((len(G), 0)), np.zeros((len(G), 0, 0)))
    for centred in range(_CENTRES):
        if level < _WELL_INSIDE and centred:
            break
        looser = max(level * 1.05 + 1e-12, _WELL_INSIDE)
        # Frequencies far below the level bind nothing, and as many of them would keep the centre where it is.
        binding, known = binding | (needed > _BINDING * level), binding
        # One number of the t is free: their sum stays below twice the number of slopes.
        barrier = replace(whole, fixed=whole.fixed[binding], looser=looser, room=2.0 * width)
        t = _newton(barrier, np.zeros(width), t * width / t.sum())
        needed, before = _needed(G, t), level
        level = needed.max()
        if level < least:
            least, best = level, t
        if level > 0.999 * before and before >= _WELL_INSIDE and np.array_equal(binding, known):
            break
    return (
        best if least < 1 else None
    )  # where little room is left, the centre at a looser level may be worse than what it began with


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


def _adjoint(matrices: Array) -> Array:
    return np.conj(np.swapaxes(matrices, 1, 2))


@dataclass(frozen=True, eq=False)
class _Barrier:
    r"""``-sum log det F``, ``F = diag(looser t, g I) - R diag(t) R' - P``, R of columns ``h_j'``, ``P = H_z'H_z``.

    F is the Schur complement of ``diag(1/t)`` in a matrix whose block for the disturbances is diagonal, ``g I -
    sizes``, in the eigenvectors of P_ww:

        [ looser diag(t) - P_pp   R_p         -P_pw       ]
        [ R_p'                    diag(1/t)   R_w'        ]
        [ -P_wp                   R_w         g I - sizes ]

    Without that block M is left, two rows for every slope: ``log det F = log det (g I - sizes) + log det M + sum log
    t``, and ``M^-1`` says all of F^-1 along ``e_j`` and ``r_j``, where t changes F.
    """

    fixed: Array  # [[-P_pp, R_p], [R_p', 0]], (f, 2 n_p, 2 n_p)
    sizes: Array  # (f, n_w)
    sides: Array  # [-P_wp, R_w], (f, n_w, 2 n_p)
    looser: float = 1.0
    room: float = np.inf  # the sum of t stays below, too

    @classmethod
    def of(cls, H: Array, width: int, sizes: Array, vectors: Array) -> _Barrier:
        """Of responses, with eigenvalues and eigenvectors of P_ww."""
        R, through = _adjoint(H[:, :width]), H[:, width:, :width]
        sides = np.concatenate([-_adjoint(H[:, width:, width:]) @ through, R[:, width:]], axis=2)
        own, fixed = R[:, :width], -_adjoint(through) @ through
        fixed = np.concatenate(
            [np.concatenate([fixed, own], axis=2), np.concatenate([_adjoint(own), np.zeros_like(own)], axis=2)], axis=1
        )
        return cls(fixed, sizes, _adjoint(vectors) @ sides)

    def of_slopes(self) -> _Barrier:
        """Return that of t alone, for any g."""
        return replace(self, sizes=self.sizes[:, :0], sides=self.sides[:, :0])

    def at(self, x: Array) -> _Point | None:
        """Return what is known of a point (t, g), or t where there are no disturbances; None outside."""
        width = self.fixed.shape[1] // 2
        t, apart, room = x[:width], x[width:] - self.sizes, self.room - x[:width].sum()
        if min(t.min(), apart.min(initial=np.inf), room) <= 0:
            return None
        unit = np.concatenate([t**-0.5, t**0.5])
        sides = self.sides * unit
        M = self.fixed * (unit[:, None] * unit) + np.diag(np.repeat([self.looser, 1.0], width))
        if apart.size:
            M -= _adjoint(sides) @ (sides / apart[:, :, None])
        try:
            root = np.linalg.cholesky(M)
        except np.linalg.LinAlgError:
            return None
        logs = 2 * np.log(np.einsum("fii->fi", root).real).sum() + len(M) * np.log(t).sum() + np.log(apart).sum()
        return _Point(
            t, apart, room, self.looser, sides, M, -float(logs + (width * np.log(room) if np.isfinite(room) else 0.0))
        )


@dataclass(frozen=True, eq=False)
class _Point:
    """A point inside, with what is known of it; M and the sides have t as their unit."""

    t: Array
    apart: Array  # g - sizes
    room: float  # for the sum of t
    looser: float
    sides: Array
    M: Array
    value: float

    def derivatives(self) -> tuple[Array, Array]:
        """Gradient and Hessian of the barrier."""
        sides, width = self.sides, len(self.t)
        inverse = np.linalg.inv(self.M)
        weight = np.concatenate([self.looser / self.t, 1 / self.t])
        G = inverse - np.diag(np.repeat([0.0, 1.0], width))  # V' F^-1 V, scaled, of V = [e_1 ... r_1 ...]
        gradient = -_signed(weight * np.einsum("fii->i", G).real)
        hessian = _signed(_signed(weight[:, None] * weight * (G.real**2 + G.imag**2).sum(axis=0)).T)
        if np.isfinite(self.room):
            gradient, hessian = gradient + width / self.room, hessian + width / self.room**2
        if not self.apart.size:
            return gradient, hessian
        once = sides / self.apart[:, :, None]
        second, third = _adjoint(once) @ once, _adjoint(once) @ (once / self.apart[:, :, None])
        part = inverse @ second
        first = -(1 / self.apart).sum() - np.einsum("fii->", part).real
        last = (
            (self.apart**-2.0).sum()
            + 2 * np.einsum("fij,fji->", inverse, third).real
            + np.einsum("fij,fji->", part, part).real
        )
        mixed = _signed(weight * np.einsum("fij,fji->i", part, inverse).real)
        return np.append(gradient, first), np.vstack([np.column_stack([hessian, mixed]), np.append(mixed, last)])


def _signed(rows: Array) -> Array:
    """Return the first half of the rows less the second: a slope brings ``e_j e_j'`` and takes ``r_j r_j'``."""
    half = len(rows) // 2
    return rows[:half] - rows[half:]


def _newton(barrier: _Barrier, cost: Array, x: Array) -> Array:
    """Minimise ``cost x`` plus the barrier from a point inside."""
    here = barrier.at(x)
    for _ in range(_NEWTON):
        if here is None:
            break
        gradient, hessian = here.derivatives()
        gradient = gradient + cost
        step = -np.linalg.lstsq(hessian, gradient, rcond=None)[0]
        decrease = -float(gradient @ step)
        if decrease < 1e-4:
            break
        length, current = 1.0, here.value + cost @ x
        while length > 1e-8:
            trial = barrier.at(x + length * step)
            if trial is not None and trial.value + cost @ (x + length * step) <= current - 0.1 * length * decrease:
                break
            length /= 2
        if length <= 1e-8:
            break
        x, here = x + length * step, trial
    return x
