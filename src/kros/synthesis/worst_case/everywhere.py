r"""Filters whose power lies below that of the uncertain set at every frequency, between those of any grid too.

Let a distribution of perturbations be given for the middle ``z_0`` of an arc: the average over the ball, elements that
are worst for an observer, or a mixture. Every one of them stays in the set when frequency changes, and with ``nu =
||N(z_0)||``

.. math:: \|X(z) - X(z_0)\|_F \le \delta
          = \frac{1}{1 - \nu}\Big(\epsilon_M + \epsilon_N \frac{\|M\|_F + \epsilon_M}{1 - \nu - \epsilon_N}\Big),
          \qquad X = \Delta (I - N \Delta)^{-1} M,

where ``epsilon`` are the distances on the arc from `arcs`. Root mean squares over the distribution obey the triangle
inequality, so the power of every channel is at least ``(sqrt(phi_i(z_0)) - delta)^2`` on the arc, for a distribution
that may differ from arc to arc. Each filter is scaled by the least ratio of the two.

Symbols
-------
phi : power of the components of w2 in the middle, shape (k, b);  delta : shape (k,)
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any

import numpy as np
import numpy.typing as npt

from ...core.linalg import adjoint
from ...core.lti import StateSpace
from ...core.rounding import AGREED, ITERATED, TINY
from .arcs import Enclosure, least_ratio
from .ball import Ball, below
from .disturbance import Channels, Shaping, Spectrum, is_diagonal

Array = npt.NDArray[Any]
Size = Callable[[Array, Array], tuple[Array, Array]]


class Everywhere:
    """Proofs for the components of w2 and of the remainder of one problem."""

    def __init__(self, channels: Channels) -> None:
        problem = channels.problem
        self.channels, self.dt = channels, problem.nominal.dt
        inside = 2 * np.pi * self.dt * channels.freqs_hz
        self.edges = np.unique(np.concatenate([[0.0], inside[inside < np.pi * (1 - ITERATED)], [np.pi]]))
        self.M = Enclosure(problem.M)
        self.N = None if problem.N is None else Enclosure(problem.N)
        self.remainder: tuple[Enclosure, Enclosure] | None = None
        if problem.remainder_left is not None and problem.remainder_right is not None:
            self.remainder = (
                Enclosure(problem.remainder_left),
                Enclosure(problem.remainder_right @ problem.input_weight),
            )

    def lowered(self, shaping: Shaping, spectrum: Spectrum) -> Shaping:
        """Scale every filter until its power is nowhere above the spectrum's."""
        remainder = None if shaping.remainder is None else self._lowered(shaping.remainder, self.remaining)
        return Shaping(self._lowered(shaping.filters, partial(self.disturbance, spectrum)), shaping.behind, remainder)

    def _lowered(self, filters: StateSpace, size: Size) -> StateSpace:
        enclosed = Enclosure(filters)

        def ratio(theta: Array, half: Array) -> tuple[Array, Array]:
            proven, seen = size(theta, half)
            response, distance = enclosed(theta, half)
            magnitude = np.linalg.norm(response, axis=-1)
            with np.errstate(divide="ignore", invalid="ignore"):
                bounds = proven / (magnitude + distance), seen / magnitude
            return tuple(np.where(magnitude + distance > 0, b, np.inf) for b in bounds)  # type: ignore[return-value]

        scale = np.minimum(least_ratio(ratio, self.edges), 1.0) * (1 - AGREED)
        return StateSpace(filters.A, filters.B, filters.C * scale[:, None], filters.D * scale[:, None], filters.dt)

    def disturbance(self, spectrum: Spectrum, theta: Array, half: Array) -> tuple[Array, Array]:
        """Magnitude of every component of w2: what is proven on the arcs and what is seen in the middle, (k, b)."""
        M, reach_M = self.M(theta, half)
        size_M, distance = np.linalg.norm(M, axis=(-2, -1)), np.linalg.norm(reach_M, axis=-1)
        N = None
        if self.N is not None:
            N, reach_N = self.N(theta, half)
            far, nu = np.linalg.norm(reach_N, axis=-1), np.linalg.norm(N, 2, axis=(-2, -1))
            room = 1 - nu - far
            with np.errstate(invalid="ignore"):
                distance = (distance + far * (size_M + distance) / np.maximum(room, TINY)) / (1 - nu)
            distance = np.where(room > 0, distance, np.inf)
        root = np.sqrt(spectrum.power(Ball.of(N, M, self.channels.problem.W_L.n_inputs), self.channels.nearest(theta)))
        if not spectrum.correlated:
            return np.maximum(root - distance[:, None], 0.0), root
        return root * _share_left(root, distance), root  # the whole matrix counts, not its diagonal alone

    def remaining(self, theta: Array, half: Array) -> tuple[Array, Array]:
        """Magnitude of every channel of the remainder, (k, n)."""
        assert self.remainder is not None
        (L, reach_L), (Q, reach_Q) = (enclosed(theta, half) for enclosed in self.remainder)
        size_Q, far_Q = np.linalg.norm(Q, axis=(-2, -1)), np.linalg.norm(reach_Q, axis=-1)
        share = 1 / np.sqrt(max(L.shape[-1], Q.shape[-2]))
        if is_diagonal(self.remainder[0].system):
            size_L = np.linalg.norm(L, axis=-1)
            least_L = np.maximum(size_L - reach_L, 0.0)
        else:
            size_L = np.sqrt(below(L @ adjoint(L)))
            least_L = size_L * _share_left(size_L, np.linalg.norm(reach_L, axis=-1))
        return share * np.maximum(size_Q - far_Q, 0.0)[:, None] * least_L, share * size_Q[:, None] * size_L


def _share_left(root: Array, distance: Array) -> Array:
    """Share of a diagonal below a spectrum that is left at a distance: ``1 - distance / min_i root_i``."""
    least = root.min(axis=-1)
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.where(least > distance, 1 - distance / least, 0.0)[:, None]
