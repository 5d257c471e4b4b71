r"""What a weight promises between grid points: the largest `sigma_max(W_L^-1 E_k W_R^-1)` over all frequencies.

Two methods. **Grid**: residuals are asked again around every high local maximum, in three rounds, each ten times finer, and in three
more around the highest. It finds what the grid shows signs of, and proves nothing. **Level sets**: where units and nominal are systems, so is every
`M_k = W_L^-1 E_k W_R^-1`, and a singular value of it equals gamma exactly where the pencil

    [ A - s F     0                B          ]
    [ -C^T C      -A^T - s F^T     -C^T D     ]      (F, A, B, C, D a descriptor realisation of M_k on s = (z - 1) / (z + 1))
    [ D^T C       B^T              D^T D - gamma^2 ]

is singular for an imaginary s. The gain is evaluated at and between its eigenvalues until no level higher by more than the margin is met by
any unit, as in the norms of `core`. Realisations of M_k, also of the remainder of a form: see `pencils`.

Eigenvalues are rounded. The pencil is therefore tried first at a level below the peak, where the grid knows all crossings: when it misses
one, the method is not used.

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
from .pencils import Descriptor, ResidualSystems, ratio_systems

Array = npt.NDArray[Any]
Ratio = Callable[[Array], Array]

_LOG = logging.getLogger(__name__)
_MARGIN = 1e-5
_LEVELS = 20
_PROBE = 0.9  # of the peak: the level at which the pencil is tried
_NEAR = 1e-3  # of its modulus: how far from the imaginary axis an eigenvalue may be
_MAXIMA, _FINER, _ZOOMS = 40, 20, (40, 40, 40, 5, 5, 5)  # how many maxima are asked again in every round


class Method(str, Enum):
    """How the bound between grid points is known."""

    GRID = "grid"
    LEVEL_SETS = "level sets"


@dataclass(frozen=True)
class Certificate:
    """Largest ratio over all frequencies."""

    method: Method
    peak: float  # attained at `freq_hz`
    freq_hz: float  # Hz
    margin: float  # by level sets no frequency exceeds ``(1 + margin) * peak``; NaN on a grid, which proves nothing of the kind


def certify(
    ratio: Ratio, freqs_hz: Array, left: StateSpace, right: StateSpace, systems: ResidualSystems | None = None
) -> Certificate:
    """Return the largest ratio (unit, n) from DC to Nyquist, from a dense grid, Hz, and by level sets where the systems are known."""
    known = ratio(freqs_hz)
    freq, peak = _sharpened(ratio, freqs_hz, known.max(axis=0))
    pencils = [] if systems is None or peak <= 0 else ratio_systems(systems, left, right)
    if not pencils or not _trusted(pencils, freqs_hz, known, left.dt):
        return Certificate(Method.GRID, peak, freq, float("nan"))
    for _ in range(_LEVELS):
        found = np.unique(np.concatenate([_candidates(p, peak * (1 + _MARGIN), left.dt) for p in pencils]))
        values = ratio(found).max(axis=0) if found.size else np.zeros(1)
        top = int(values.argmax())
        if values[top] <= peak * (1 + _MARGIN):
            return Certificate(Method.LEVEL_SETS, peak, freq, _MARGIN)
        peak, freq = float(values[top]), float(found[top])
    return Certificate(Method.GRID, peak, freq, float("nan"))


def _sharpened(ratio: Ratio, freqs_hz: Array, known: Array) -> tuple[float, float]:
    """Frequency and height of the highest peak, asked again around the local maxima."""
    inner = np.concatenate([[-np.inf], known, [-np.inf]])
    tops = np.flatnonzero((known >= inner[:-2]) & (known >= inner[2:]))
    tops = tops[np.argsort(-known[tops])[:_MAXIMA]]
    low, high = freqs_hz[np.maximum(tops - 1, 0)], freqs_hz[np.minimum(tops + 1, len(freqs_hz) - 1)]
    best = float(freqs_hz[known.argmax()]), float(known.max())
    for kept in _ZOOMS:
        low, high = low[:kept], high[:kept]
        points = low[:, None] + (high - low)[:, None] * np.linspace(0, 1, _FINER + 1)
        values = ratio(points.ravel()).max(axis=0).reshape(points.shape)
        rows, columns = np.arange(len(points)), values.argmax(axis=1)
        row = int(values.max(axis=1).argmax())
        if values[row, columns[row]] > best[1]:
            best = float(points[row, columns[row]]), float(values[row, columns[row]])
        low, high = points[rows, np.maximum(columns - 1, 0)], points[rows, np.minimum(columns + 1, _FINER)]
        highest = np.argsort(-values.max(axis=1), kind="stable")
        low, high = low[highest], high[highest]
    return best


def _candidates(pencil: Descriptor, gamma: float, dt: float) -> Array:
    """Frequencies, Hz, at which a singular value may equal gamma, and points between them."""
    found = pencil.crossings(gamma)
    near = found[(np.abs(found.real) <= _NEAR * np.abs(found)) & (found.imag > 0)].imag
    points = np.unique(np.arctan(near) / (np.pi * dt))
    ends = np.concatenate([[0.0], points, [nyquist_hz(dt)]])
    return np.concatenate([ends, (ends[1:] + ends[:-1]) / 2, np.sqrt(points[1:] * points[:-1])])


def _trusted(pencils: list[Descriptor], freqs_hz: Array, known: Array, dt: float) -> bool:
    """Whether the pencil of the worst unit has an eigenvalue at every crossing that the grid shows."""
    unit = int(known.max(axis=1).argmax())
    level = _PROBE * float(known[unit].max())
    above = known[unit] > level
    crossing = np.flatnonzero(above[1:] != above[:-1])
    found = pencils[unit].crossings(level)
    at = np.sort(np.arctan(found[(np.abs(found.real) <= _NEAR * np.abs(found)) & (found.imag > 0)].imag) / (np.pi * dt))
    low, high = freqs_hz[crossing] * (1 - _NEAR), freqs_hz[crossing + 1] * (1 + _NEAR)
    seen = np.searchsorted(at, high, side="right") > np.searchsorted(at, low)
    if not seen.all():
        _LOG.debug("Certificate: %d of %d crossings have no eigenvalue; the grid decides", (~seen).sum(), len(seen))
    return bool(seen.all())
