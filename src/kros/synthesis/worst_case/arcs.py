r"""Enclosures of a rational system on arcs of the unit circle, and a ratio proven on all of them.

Around the middle ``z_0`` of an arc, with ``R_0 = (z_0 I - A)^{-1}`` and ``h >= |z - z_0|``, the Neumann series of the
resolvent gives for every row

.. math:: \|c_i^T (R - R_0) B\| \le h \|c_i^T R_0^2 B\| + h^2 \frac{\|c_i^T R_0^2\| \|R_0 B\|}{1 - h \|R_0\|},
          \qquad h \|R_0\| < 1.

It holds in all coordinates of the state; those in which white noise gives every state the same size and no correlation
keep ``R_0`` small. Arcs on which the enclosure is not good enough are halved: no frequency is left out, and no decision
is made at a point.

Symbols
-------
theta, half : middle and half width of the arcs, rad, shape (k,)
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import numpy.typing as npt

from ...core.lti import StateSpace
from ...core.norms import gramian

Array = npt.NDArray[Any]
Ratio = Callable[[Array, Array], tuple[Array, Array]]

_CORRELATED = 1e-10  # regularises the coordinates, in which everything holds whatever they are
_ROUNDING = 1e-7  # of responses, relative
_RESOLVENT = 1e-14  # of resolvents, relative, for every state: what counts near a pole


class Enclosure:
    """Response of a stable discrete system on arcs."""

    def __init__(self, system: StateSpace) -> None:
        self.system = system
        T = _even_coordinates(system)
        self._A = np.linalg.solve(T, system.A @ T) - np.eye(system.n_states)  # of z - 1, for low frequencies
        self._B, self._C = np.linalg.solve(T, system.B), system.C @ T

    def __call__(self, theta: Array, half: Array) -> tuple[Array, Array]:
        """Return the response in the middle, (k, p, m), and the distance of every row from it on the arc, (k, p)."""
        R = self._resolvent(theta)
        CR, RB = self._C @ R, R @ self._B
        response = CR @ self._B + self.system.D
        size = _size(response, -1)
        if not self.system.n_states:
            return response, _ROUNDING * size
        moduli = np.abs(R)
        size_R = np.sqrt(moduli.sum(axis=-1).max(axis=-1) * moduli.sum(axis=-2).max(axis=-1))
        reach, reached = (half * size_R)[:, None], _size(RB, (-2, -1))[:, None]
        tail = _size(CR @ R, -1) * reached / np.where(reach < 1, 1 - reach, 1.0)
        lost = self.system.n_states * _RESOLVENT * _size(CR, -1) * reached
        h = half[:, None]
        distance = h * _size(CR @ RB, -1) + h**2 * tail + lost + _ROUNDING * size
        return response, np.where(reach < 1, distance, np.inf)

    def _resolvent(self, theta: Array) -> Array:
        return np.linalg.inv(np.expm1(1j * theta)[:, None, None] * np.eye(self.system.n_states) - self._A)


def _size(values: Array, axis: int | tuple[int, int]) -> Array:
    """Root of the sum of squares."""
    return np.asarray(np.sqrt(np.sum(values.real**2 + values.imag**2, axis=axis)))


def _even_coordinates(system: StateSpace) -> Array:
    """States of equal size and without correlation under white noise, as far as they are reached."""
    P = gramian(system.A, system.B, system.dt)
    size = np.sqrt(np.maximum(np.diag(P), 0.0))
    size = np.where(size > 0, size, 1.0)
    values, vectors = np.linalg.eigh(P / size / size[:, None])
    return np.asarray(size[:, None] * vectors * np.sqrt(np.maximum(values, 0.0) + _CORRELATED))


def least_ratio(ratio: Ratio, edges: Array, rtol: float = 3e-3, max_arcs: int = 20000, rounds: int = 60) -> Array:
    """Return what a ratio of responses nowhere falls below, for every channel."""
    theta, half = (edges[1:] + edges[:-1]) / 2, np.diff(edges) / 2
    proven, seen = ratio(theta, half)
    least = seen.min(axis=0)
    done = np.full_like(least, np.inf)
    tried = len(theta)
    for _ in range(rounds):
        least = np.minimum(least, seen.min(axis=0, initial=np.inf))
        loose = (proven < (1 - rtol) * least).any(axis=1)
        done = np.minimum(done, proven[~loose].min(axis=0, initial=np.inf))
        tried += 2 * int(loose.sum())
        if not loose.any() or tried > max_arcs:
            break
        quarter = half[loose] / 2
        theta = np.concatenate([theta[loose] - quarter, theta[loose] + quarter])
        half = np.concatenate([quarter, quarter])
        proven, seen = ratio(theta, half)
    else:
        loose = np.full(len(theta), True)
    return np.minimum(done, proven[loose].min(axis=0, initial=np.inf))
