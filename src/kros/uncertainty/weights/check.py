"""Where a weight is checked: at which frequencies, what residuals count there, and what was found."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from ...core.frequency import bilinear_squared, dense_grid
from ...core.lti import StateSpace
from ...core.small_matrices import sigma_max
from .certificate import Certificate, Method, certify
from .pencils import ResidualSystems

Array = npt.NDArray[Any]
Residuals = Callable[[Array], Array]

DENSITY = 10  # how much denser than that of a fit the grid of its check is
_TAIL = 16  # points towards DC and Nyquist, four a decade
_BETWEEN = 3  # steps between known points in which a fit is held up
_EVEN, _A_DECADE = 101, 30  # frequencies at which a bound is checked at least
_DIP = 10 ** (-3 / 20)
_SAME = 1e-9  # relative distance of frequencies that are one


@dataclass(frozen=True, eq=False)
class Checks:
    """How a weight is checked."""

    also_hz: Array | None = None  # (n,), Hz, optional: further frequencies, where residuals peak between the points
    systems: ResidualSystems | None = None  # for a proof by level sets
    # residuals are known at the frequencies of the fit only: there, and beyond their ends, the bound is claimed. Between them the fit
    # is kept above what `between_points` draws, and nothing is claimed
    sampled: bool = False

    def grid(self, freqs_hz: Array, sample_period_s: float) -> Array:
        """Return the frequencies at which a fit is checked."""
        if self.sampled:
            return checking_grid(freqs_hz, sample_period_s, _BETWEEN)
        return checking_grid(freqs_hz, sample_period_s, DENSITY, self.also_hz, filled=True)

    def of_fit(self, freqs_hz: Array) -> Array:
        """Return the frequencies that a fit follows: those asked for, and the peaks between them."""
        if self.also_hz is None:
            return freqs_hz
        inside = (self.also_hz >= freqs_hz[0]) & (self.also_hz <= freqs_hz[-1])
        return joined(freqs_hz, self.also_hz[inside])[0]

    def claimed(self, freqs_hz: Array, sample_period_s: float) -> Array:
        """Return the frequencies at which the bound has to hold to begin with."""
        return checking_grid(freqs_hz, sample_period_s, 1) if self.sampled else self.grid(freqs_hz, sample_period_s)

    def proof(
        self, ratio: Callable[[Array], Array], claimed_hz: Array, left: StateSpace, right: StateSpace
    ) -> Certificate:
        """Return the largest ratio wherever the bound is claimed."""
        if not self.sampled:
            return certify(ratio, claimed_hz, left, right, self.systems)
        known = ratio(claimed_hz).max(axis=0)
        return Certificate(Method.GRID, float(known.max()), float(claimed_hz[known.argmax()]), float("nan"))


def checking_grid(
    freqs_hz: Array, sample_period_s: float, density: int, also_hz: Array | None = None, *, filled: bool = False
) -> Array:
    """Return a dense grid that goes on from its ends to DC and Nyquist, in decades of tau: a fit is free to bend wherever nobody looks."""
    dense = dense_grid(freqs_hz, sample_period_s, density)
    inner = dense[(dense > 0) & (bilinear_squared(dense, sample_period_s) < np.inf)]
    tails = 10.0 ** (np.arange(1, _TAIL + 1) / 4)
    tau = bilinear_squared(inner[[0, -1]], sample_period_s) if inner.size else np.ones(2)
    further = np.append(tau[0] / tails**2, tau[1] * tails)
    dense = np.unique(np.concatenate([dense, np.arctan(np.sqrt(further)) / (np.pi * sample_period_s)]))
    if filled:
        top, low = dense[-1], dense[dense > 0][0]
        decades = np.geomspace(low, top, 2 + int(_A_DECADE * np.log10(top / low)))
        dense = joined(dense, np.concatenate([decades[1:-1], np.linspace(0.0, top, _EVEN)[1:-1]]))[0]
    return dense if also_hz is None else joined(dense, also_hz)[0]


def joined(freqs_hz: Array, others_hz: Array) -> tuple[Array, Array]:
    """Return both in increasing order without those of the others that are nearly there, and where each comes from in their concatenation."""
    both = np.concatenate([freqs_hz, others_hz])
    others = np.unique(others_hz, return_index=True)[1]
    at = np.searchsorted(freqs_hz, others_hz[others]).clip(1, max(len(freqs_hz) - 1, 1))
    near = np.minimum(
        np.abs(others_hz[others] - freqs_hz[at - 1]),
        np.abs(others_hz[others] - freqs_hz[np.minimum(at, len(freqs_hz) - 1)]),
    )
    index = np.concatenate([np.arange(len(freqs_hz)), len(freqs_hz) + others[near > _SAME * others_hz[others]]])
    index = index[np.argsort(both[index], kind="stable")]
    return both[index], index


def between_points(E: Array, freqs_hz: Array) -> Residuals:
    """Return residuals at any frequency: those of the nearest point, between two points 3 dB below the smaller of both."""
    size = sigma_max(E).max(axis=0)

    def at(asked_hz: Array) -> Array:
        near = nearest(freqs_hz, asked_hz)
        other = np.clip(near + np.where(asked_hz > freqs_hz[near], 1, -1), 0, len(freqs_hz) - 1)
        known = (np.abs(asked_hz - freqs_hz[near]) <= _SAME * freqs_hz[near]) | (other == near) | (size[near] == 0)
        floor = _DIP * np.minimum(size[near], size[other]) / np.where(size[near] > 0, size[near], 1.0)
        return np.asarray(E[:, near] * np.where(known, 1.0, floor)[:, None, None])

    return at


def nearest(grid: Array, freqs_hz: Array) -> npt.NDArray[np.intp]:
    """Return the index of the nearest grid point; the ends stand for what is beyond them."""
    if len(grid) == 1:
        return np.zeros(len(freqs_hz), np.intp)
    return np.asarray(np.searchsorted((grid[1:] + grid[:-1]) / 2, freqs_hz))
