r"""The imaginary axis as a unit circle: continuous weights by a discrete fit, without approximation.

    s = (2 / T) (z - 1) / (z + 1)        j 2 pi f = j (2 / T) tan(theta / 2),   theta = 2 pi f_d T

maps the unit circle onto the imaginary axis one to one, Nyquist to infinity, and stable minimum-phase systems to stable
minimum-phase systems of the same order. A magnitude that bounds residuals at the mapped frequencies f_d bounds them at
f: nothing is sampled. The period T is that of the map and of nothing else.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from ...core.errors import ConfigError
from ...core.frequency import check_grid
from ...core.lti import StateSpace
from ...core.norms import to_continuous
from ..settings import MAGNITUDE, SET

Array = npt.NDArray[Any]


@dataclass(frozen=True)
class BilinearAxis:
    """Map between a continuous and a discrete frequency axis."""

    period_s: float  # s: period T of the map

    @classmethod
    def over(cls, freqs_hz: Array) -> BilinearAxis:
        """Return the map for a grid, whose end becomes the highest knot of the fit."""
        return cls(float(np.sqrt(MAGNITUDE.highest) / (np.pi * freqs_hz[-1])))

    def discrete_hz(self, freqs_hz: npt.ArrayLike) -> Array:
        """Return the frequencies on the discrete axis."""
        return np.asarray(np.arctan(np.pi * self.period_s * np.asarray(freqs_hz, float)) / (np.pi * self.period_s))

    def continuous(self, system: StateSpace) -> StateSpace:
        """Return the continuous system with the same response at mapped frequencies."""
        mapped, rate = to_continuous(system), 2 / self.period_s
        return StateSpace(rate * mapped.A, np.sqrt(rate) * mapped.B, np.sqrt(rate) * mapped.C, mapped.D, 0.0)

    def discrete(self, system: StateSpace) -> StateSpace:
        """Return the discrete system, or batch, with the same response at mapped frequencies."""
        eye, rate = np.eye(system.n_states), 2 / self.period_s
        inverse = np.linalg.inv(rate * eye - system.A)
        scale = np.sqrt(2 * rate)
        A, through = inverse @ (rate * eye + system.A), system.C @ inverse @ system.B
        B, C = scale * (inverse @ system.B), scale * (system.C @ inverse)
        return StateSpace(A, B, C, system.D + through, self.period_s)


def continuous_grid(system: StateSpace, freqs_hz: npt.ArrayLike | None) -> Array:
    """Return frequencies, by default a hundredth of the slowest to ten times the fastest pole, and some beyond, Hz."""
    if freqs_hz is None:
        sizes = np.abs(system.poles()) / (2 * np.pi)
        if not sizes.any():
            raise ConfigError("Frequency grid: static continuous models have no band of their own; give freqs_hz.")
        freqs_hz = np.geomspace(sizes[sizes > 0].min() / 100, sizes.max() * 10, SET.points)
    freqs = check_grid(freqs_hz, None)
    return np.concatenate([freqs, np.geomspace(freqs[-1], 10 * freqs[-1], SET.points_beyond + 1)[1:]])
