r"""What a weight promises between grid points: the largest `sigma_max(W_L^-1 E_k W_R^-1)` over all frequencies.

**Level sets**: where units and nominal are systems, so is every `M_k = W_L^-1 E_k W_R^-1`, and a singular value of it
equals gamma exactly where a pencil is singular for an imaginary s (`pencils`). The gain is evaluated at and between its
eigenvalues until no level higher by more than the margin is met by any unit. Eigenvalues are rounded: the pencil is
tried first at a level below the peak, where the grid knows all crossings, and when it misses one the proof is refused.
**Grid**: responses alone, continuous systems and refused proofs have the peaks of a dense grid, which proves nothing
between its points.

References
----------
N. A. Bruinsma and M. Steinbuch, "A fast algorithm to compute the H-infinity norm of a transfer function matrix",
Systems & Control Letters 14 (1990) 287-293.
"""

from __future__ import annotations

import logging
from collections.abc import Callable
from dataclasses import dataclass
from enum import Enum
from typing import Any

import numpy as np
import numpy.typing as npt

from ...core.frequency import nyquist_hz
from ...core.lti import StateSpace
from .pencils import Descriptor, ResidualSystems

Array = npt.NDArray[Any]
Ratio = Callable[[Array], Array]

_LOG = logging.getLogger(__name__)
_MARGIN = 1e-5
_LEVELS = 20  # limit; two or three are met
_PROBE = 0.9  # of the peak: the level at which the pencil is tried
_NEAR = 1e-3  # of its modulus: how far from the imaginary axis an eigenvalue may be
_FINER, _ZOOMS = 20, 3  # points and rounds between the neighbours of a maximum


class Method(str, Enum):
    """How the bound between grid points is known."""

    GRID = "grid"
    LEVEL_SETS = "level sets"


@dataclass(frozen=True)
class Certificate:
    """Largest ratio over all frequencies, attained at `freq_hz`."""

    method: Method
    peak: float
    freq_hz: float

    @property
    def bound(self) -> float:
        """What no ratio exceeds, by level sets; the largest one that was evaluated, on a grid."""
        return self.peak * (1 + _MARGIN) if self.method is Method.LEVEL_SETS else self.peak


def certify(
    ratio: Ratio,
    freqs_hz: Array,
    known: Array,
    left: StateSpace,
    right: StateSpace,
    systems: ResidualSystems | None = None,
) -> Certificate:
    """Return the largest ratio (unit, n) from DC to Nyquist, from a dense grid, Hz, by level sets if possible."""
    freq, peak = _sharpened(ratio, freqs_hz, known.max(axis=0))
    pencils = [] if systems is None or peak <= 0 else systems.ratios(left, right)
    if not pencils or not _trusted(pencils, freqs_hz, known, left.dt):
        return Certificate(Method.GRID, peak, freq)
    for _ in range(_LEVELS):
        points = np.unique(np.concatenate([_candidates(p, peak * (1 + _MARGIN), left.dt) for p in pencils]))
        values = ratio(points).max(axis=0)
        top = int(values.argmax())
        if values[top] <= peak * (1 + _MARGIN):
            return Certificate(Method.LEVEL_SETS, peak, freq)
        peak, freq = float(values[top]), float(points[top])
    return Certificate(Method.GRID, peak, freq)


def _sharpened(ratio: Ratio, freqs_hz: Array, known: Array) -> tuple[float, float]:
    """Return frequency and height of the highest peak, evaluated more densely between its neighbours."""
    for _ in range(_ZOOMS):
        top = int(known.argmax())
        low, high = freqs_hz[max(top - 1, 0)], freqs_hz[min(top + 1, len(freqs_hz) - 1)]
        freqs_hz = np.unique(np.append(np.linspace(low, high, _FINER + 1), freqs_hz[top]))
        known = ratio(freqs_hz).max(axis=0)
    top = int(known.argmax())
    return float(freqs_hz[top]), float(known[top])


def _crossings_hz(pencil: Descriptor, gamma: float, dt: float) -> Array:
    """Return the frequencies, Hz, at which a singular value may equal gamma."""
    s = pencil.crossings(gamma)
    near = s[(np.abs(s.real) <= _NEAR * np.abs(s)) & (s.imag > 0)].imag
    return np.unique(np.arctan(near) / (np.pi * dt))


def _candidates(pencil: Descriptor, gamma: float, dt: float) -> Array:
    """Return the crossings of a level and points between them."""
    points = _crossings_hz(pencil, gamma, dt)
    ends = np.concatenate([[0.0], points, [nyquist_hz(dt)]])
    return np.concatenate([ends, (ends[1:] + ends[:-1]) / 2, np.sqrt(points[1:] * points[:-1])])


def _trusted(pencils: list[Descriptor], freqs_hz: Array, known: Array, dt: float) -> bool:
    """Tell whether the pencil of the worst unit has an eigenvalue at every crossing that the grid shows."""
    unit = int(known.max(axis=1).argmax())
    level = _PROBE * float(known[unit].max())
    above = known[unit] > level
    crossing = np.flatnonzero(above[1:] != above[:-1])
    at = _crossings_hz(pencils[unit], level, dt)
    low, high = freqs_hz[crossing] * (1 - _NEAR), freqs_hz[crossing + 1] * (1 + _NEAR)
    seen = np.searchsorted(at, high, side="right") > np.searchsorted(at, low)
    if not seen.all():
        _LOG.debug("Certificate: %d of %d crossings have no eigenvalue; the grid decides", (~seen).sum(), len(seen))
    return bool(seen.all())
