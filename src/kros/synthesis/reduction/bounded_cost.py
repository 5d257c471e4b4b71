r"""H2 cost of channel 1 with a barrier that keeps the H-infinity norm of channel 2 below a bound.

.. math:: \|T_{11}\|_2^2 + \mu \, \frac{1}{N}\sum_k \mathrm{tr}\big[(I - T_{22}^H T_{22} / \gamma^2)^{-1} - I\big]

The barrier grows without limit where a singular value reaches the bound between the nodes as at them, since the sum then behaves like
``(1 - sigma/gamma)^(-1/2)`` of the peak; that no frequency exceeds the bound is decided by the norm itself. The nodes are equal in logarithmic
frequency, because any measure will do.

Symbols
-------
gamma : bound;  mu : weight of the barrier
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from ...core.errors import KrosError
from ...core.linalg import adjoint
from ...core.lti import StateSpace
from ...core.norms import hinf_norm
from .affine_loop import AffineLoop

Array = npt.NDArray[Any]

_POINTS = 300


@dataclass(frozen=True, eq=False)
class BoundedCost:
    """Value and gradient; infinite outside the bound."""

    loop: AffineLoop
    bound: float
    barrier: float
    freqs_hz: Array

    @classmethod
    def around(cls, loop: AffineLoop, theta: Array, bound: float, barrier: float) -> BoundedCost:
        """Lay nodes over the frequencies of the closed loop's poles."""
        closed = loop.close(theta)
        poles = closed.poles().astype(complex)
        sizes = np.abs(np.log(np.where(np.abs(poles) > 1e-3, poles, 1e-3))) / closed.dt if closed.dt > 0 else np.abs(poles)
        low, high = sizes.min(initial=1.0) / 30, np.pi / closed.dt if closed.dt > 0 else 30 * sizes.max(initial=1.0)
        resonant = np.abs(poles.imag) if closed.dt == 0 else np.abs(np.angle(poles)) / closed.dt
        around = (resonant[:, None] * np.linspace(0.97, 1.03, 7)).ravel()
        grid = np.concatenate([np.geomspace(low, high, _POINTS), around[(around > low) & (around < high)]])
        return cls(loop, bound, barrier, np.unique(grid) / (2 * np.pi))

    def __call__(self, theta: Array) -> tuple[float, Array]:
        """Return the cost and its gradient."""
        plant = self.loop.plant
        value, gradient = self.loop.h2_squared(theta, plant.rows(1), plant.columns(1))
        rows, columns = plant.rows(2), plant.columns(2)
        if not np.isfinite(value) or not self._within(theta, rows, columns):
            return float("inf"), np.zeros_like(theta)
        left, T, right = self.loop.responses(theta, self.freqs_hz)
        left, T, right = left[:, rows], T[:, rows, columns], right[:, :, columns]
        inverse = np.linalg.inv(np.eye(T.shape[-1]) - adjoint(T) @ T / self.bound**2)
        excess = np.real(np.einsum("fii->f", inverse)) - T.shape[-1]
        towards = 2 / self.bound**2 * T @ inverse @ inverse
        weight = self.barrier / len(self.freqs_hz)
        slope = np.real(np.sum(adjoint(left) @ towards @ adjoint(right), axis=0))
        return value + weight * float(excess.sum()), gradient + weight * slope

    def _within(self, theta: Array, rows: slice, columns: slice) -> bool:
        closed = self.loop.close(theta)
        try:
            norm = hinf_norm(StateSpace(closed.A, closed.B[:, columns], closed.C[rows], closed.D[rows, columns], closed.dt))
        except KrosError:
            return False
        return norm * (1 + 2e-6) < self.bound
