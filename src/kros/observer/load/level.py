r"""The level of a load that is fixed to an angle.

What is seen of a load lacks its level (`without_level`). A mass mounted off the axis takes ``tau = c_1 sin(theta) + c_2 cos(theta)`` plus what is fast. The
same filter makes ``psi = H phi`` of ``phi = [sin(theta), cos(theta)]``, so that the seen part tells c by least squares as soon as the machine turns,

.. math:: \hat c_k = \Bigl(\sum_j \psi_j \psi_j^T T + \epsilon I\Bigr)^{-1} \sum_j \psi_j \hat\tau_s(j) T, \qquad
          \hat\tau = \hat\tau_s + (\varphi - \psi)^T \hat c .

Only what is missing is filled in: fast and unexpected loads pass as they are seen, and without load c stays near zero.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from .signals import without_level

Array = npt.NDArray[np.float64]


@dataclass(frozen=True)
class AngleLoad:
    """Fill in the level of loads that are fixed to an angle.

    Parameters
    ----------
    level_s : float, s
        Of the load observer.
    sample_period_s : float
    settling_s : float, s
        Time at full swing (sin^2 of one half) after which half of c is believed.
    """

    level_s: float
    sample_period_s: float
    settling_s: float = 0.1

    def run(self, seen: npt.ArrayLike, position: npt.ArrayLike) -> Array:
        """Return loads with their level, shape (n_samples, batch), from seen parts and measured angles in rad, of that shape."""
        seen, position = np.asarray(seen, dtype=float), np.asarray(position, dtype=float)
        phi = np.stack([np.sin(position), np.cos(position)], axis=-1)
        psi = without_level(phi, self.level_s, self.sample_period_s)
        gram = np.cumsum(psi[..., :, None] * psi[..., None, :], axis=0) * self.sample_period_s + self._trust
        right = np.cumsum(psi * seen[..., None], axis=0) * self.sample_period_s
        return np.asarray(seen + np.sum((phi - psi) * np.linalg.solve(gram, right[..., None])[..., 0], axis=-1))

    @property
    def _trust(self) -> Array:
        return 0.5 * self.settling_s * np.eye(2)

    def start(self, position: float) -> RunningAngleLoad:
        """Return the same, sample by sample, for a machine that starts at an angle in rad."""
        return RunningAngleLoad(self, float(position))


class RunningAngleLoad:
    """`AngleLoad` sample by sample."""

    def __init__(self, settings: AngleLoad, position: float) -> None:
        self.settings = settings
        self._pole = float(np.exp(-settings.sample_period_s / settings.level_s))
        self._before = np.array([np.sin(position), np.cos(position)])
        self._psi, self._gram, self._right = np.zeros(2), settings._trust, np.zeros(2)

    def step(self, seen: float, position: float) -> float:
        """Return the load now, from its seen part and the measured angle in rad."""
        phi = np.array([np.sin(position), np.cos(position)])
        self._psi = self._pole * self._psi + phi - self._before
        self._before = phi
        dt = self.settings.sample_period_s
        self._gram = self._gram + np.outer(self._psi, self._psi) * dt
        self._right = self._right + self._psi * seen * dt
        return float(seen + (phi - self._psi) @ np.linalg.solve(self._gram, self._right))
