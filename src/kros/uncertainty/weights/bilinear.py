r"""The imaginary axis as a unit circle: continuous weights by a discrete fit, without approximation.

    s = (2 / T) (z - 1) / (z + 1)        j 2 pi f = j (2 / T) tan(theta / 2),   theta = 2 pi f_d T

maps the unit circle onto the imaginary axis one to one, Nyquist to infinity, and stable minimum-phase systems to stable
minimum-phase systems of the same order. A magnitude that bounds residuals at the mapped frequencies f_d bounds them at
f: nothing is sampled. The period T is that of the map and of nothing else.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import numpy.typing as npt

from ...core.errors import ConfigError
from ...core.lti import StateSpace
from ...core.norms import to_continuous
from ..settings import SET
from .residuals import Residuals

Array = npt.NDArray[Any]


@dataclass(frozen=True)
class BilinearAxis:
    """Map between a continuous and a discrete frequency axis."""

    period_s: float  # s: period T of the map
    # Hz: end of the grid, from which on residuals count as constant: numerically a strictly proper plant has no
    # pseudo-inverse there, and an additive residual vanishes faster than a weight with a stable inverse may
    last_hz: float

    @classmethod
    def over(cls, freqs_hz: Array) -> BilinearAxis:
        """Return the map for a grid, to whose end it gives tau = 10, the highest knot of the fit."""
        top = float(freqs_hz[-1])
        return cls(float(np.sqrt(10.0)) / (np.pi * top), top)

    def discrete_hz(self, freqs_hz: npt.ArrayLike) -> Array:
        """Return the frequencies on the discrete axis."""
        return np.asarray(np.arctan(np.pi * self.period_s * np.asarray(freqs_hz, float)) / (np.pi * self.period_s))

    def continuous_hz(self, freqs_hz: npt.ArrayLike) -> Array:
        """Return the frequencies on the continuous axis, at most `last_hz`."""
        angle = np.pi * self.period_s * np.asarray(freqs_hz, float)
        return np.asarray(np.minimum(np.tan(np.minimum(angle, np.pi / 2)) / (np.pi * self.period_s), self.last_hz))

    def mapped(self, residuals: Residuals) -> Residuals:
        """Return residuals at mapped frequencies, constant from `last_hz` on."""

        def units(freqs_hz: Array, rows: Array) -> Array:
            return residuals.units(self.continuous_hz(freqs_hz), rows)

        def nominal(freqs_hz: Array) -> Array:
            return residuals.nominal(self.continuous_hz(freqs_hz))

        base, others = residuals.systems or (None, None)
        systems = None if base is None or others is None else (self.discrete(base), self.discrete(others))
        return replace(residuals, nominal=nominal, units=units, systems=systems, proven=False)

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


def beyond(freqs_hz: Array) -> Array:
    """Return the frequencies, and more of them up to ten times the last."""
    top = freqs_hz[-1]
    return np.concatenate([freqs_hz, np.geomspace(top, SET.beyond * top, SET.points_beyond + 1)[1:]])


def continuous_grid(system: StateSpace) -> Array:
    """Return 1000 logarithmic points from a hundredth of the slowest to ten times the fastest pole, Hz."""
    sizes = np.abs(system.poles()) / (2 * np.pi)
    sizes = sizes[sizes > 0]
    if not sizes.size:
        raise ConfigError("Frequency grid: static continuous models have no band of their own; give freqs_hz.")
    return np.geomspace(sizes.min() / 100, sizes.max() * 10, SET.points)
