"""Random stable causal contractions, many at once: orthonormal matrices around diagonal all-pass filters.

Symbols
-------
k : the smaller of rows and columns;  p : pole of an all-pass factor ``(1 - conj(p) z) / (z - p)``, NaN where there is none
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from ..core.lti import StateSpace, block_diagonal, gain

Array = npt.NDArray[Any]
_CORNERS = np.log([1e-4, 2.0])  # of rad per sample
_DAMPING = np.log([0.05, 1.0])
_BOUNDARY = 0.5  # share of members of norm one


@dataclass(frozen=True, eq=False)
class Contractions:
    """Contractions ``r U_1 B_1(z) U_2 B_2(z) U_3``, member axis first.

    Parameters
    ----------
    size : ndarray, shape (member,)
        r, the H-infinity norm.
    first, middle, last : ndarray, shape (member, rows, k), (member, k, k), (member, k, columns)
    poles : ndarray, shape (member, 2, k, 2), complex
        Poles of the all-pass filters of both diagonals: a conjugate pair, a real one and NaN, or two NaN.
    """

    size: Array
    first: Array
    middle: Array
    last: Array
    poles: Array

    @classmethod
    def draw(cls, rows: int, columns: int, members: int, rng: np.random.Generator) -> Contractions:
        """Draw members of a size: a third each without poles, with real and with complex ones."""
        k = min(rows, columns)
        size = np.where(rng.random(members) < _BOUNDARY, 1.0, rng.random(members))
        first, middle = _orthonormal(rng, members, rows, k), _orthonormal(rng, members, k, k)
        last = np.swapaxes(_orthonormal(rng, members, columns, k), -1, -2)
        degree = (np.arange(members) % 3)[:, None, None] * np.ones((1, 2, k), int)
        corner = np.exp(rng.uniform(_CORNERS[0], _CORNERS[1], size=degree.shape))
        damping = np.exp(rng.uniform(_DAMPING[0], _DAMPING[1], size=degree.shape))
        pair = np.exp(corner * (-damping + 1j * np.sqrt(1 - damping**2)))
        single = np.exp(-corner) * np.where(rng.random(degree.shape) < 0.5, 1.0, -1.0)
        poles = np.stack([np.where(degree == 2, pair, single), np.where(degree == 2, np.conj(pair), np.nan)], axis=-1)
        poles[degree == 0] = np.nan
        return cls(size, first, middle, last, poles)

    def some(self, part: slice) -> Contractions:
        """Return some members."""
        return Contractions(self.size[part], self.first[part], self.middle[part], self.last[part], self.poles[part])

    def response(self, theta: Array) -> Array:
        """Return the responses at angles on the unit circle, shape (member, f, rows, columns)."""
        z = np.exp(1j * theta)[:, None, None]  # (f, 1, 1)
        none = np.isnan(self.poles)[:, :, None]  # (member, 2, 1, k, 2)
        p = np.where(none, 0.0, self.poles[:, :, None])
        factors = np.where(none, 1.0, (1 - np.conj(p) * z) / (z - p))
        diagonal = factors.prod(axis=-1)
        inner = diagonal[:, 0, :, :, None] * self.middle[:, None] * diagonal[:, 1, :, None, :]
        return np.asarray(self.size[:, None, None, None] * (self.first[:, None] @ inner @ self.last[:, None]))

    def system(self, member: int, dt: float) -> StateSpace:
        """Return one member as a state-space model."""
        left, right = (_diagonal(poles, dt) for poles in self.poles[member])
        outer = gain(self.size[member] * self.first[member], dt)
        return outer @ left @ gain(self.middle[member], dt) @ right @ gain(self.last[member], dt)


def _orthonormal(rng: np.random.Generator, members: int, rows: int, columns: int) -> Array:
    """Uniform matrices with orthonormal columns, shape (member, rows, columns)."""
    Q, R = np.linalg.qr(rng.standard_normal((members, rows, columns)))
    return np.asarray(Q * np.where(np.einsum("mii->mi", R) < 0, -1.0, 1.0)[:, None, :])


def _diagonal(poles: Array, dt: float) -> StateSpace:
    return block_diagonal([_all_pass(p, dt) for p in poles])


def _all_pass(poles: Array, dt: float) -> StateSpace:
    """All-pass filter of one entry, of as many states as it has poles."""
    known = poles[~np.isnan(poles)]
    if not len(known):
        return gain([[1.0]], dt)
    a = np.real(np.poly(known))  # z^d + a_1 z^(d-1) + ..., the numerator has the same coefficients in reverse
    d = len(known)
    A = np.vstack([-a[1:], np.eye(d)[:-1]])
    C = a[::-1][1:] - a[-1] * a[1:]
    return StateSpace(A, np.eye(d)[:, :1], C[None], a[-1:][None], dt)
