"""The linear programs behind `fit`: iterations towards the best rational bound on a grid, for fixed knots.

Two iterations, both in the coefficients a and b of n and d, with `e` the denominator of the step before:

    start (Sanathanan-Koerner):  minimise t  s.t.  |n_i / f_i - d_i| <= t e_i,                            mean(d / e) = 1
    improve (Dinkelbach):        minimise t  s.t.  d_i <= n_i / f_i,  n_i / (gamma f_i) - d_i <= t e_i,   mean(d / e) = 1

The first needs no guess of the ratio gamma and is exact at once for data of that order; the second converges superlinearly to the global
optimum from any bound. Rows are relative to what the denominator really is, columns to their largest entry, because programs are solved to absolute
tolerances; each starts from the active rows of the one before.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from .program import solve
from .spectral import RationalMagnitude, basis

Array = npt.NDArray[Any]

_EDGE = 1e-4  # how far n and d may fall between the ends of the grid and DC or Nyquist
_STARTS = 10
_STEPS = 12
_EXACT_DB = 1e-4
_STALLED_DB = 5e-3


@dataclass
class Programs:
    """How many linear programs may still be solved: bad data would take thousands, one after the other, and gain nothing."""

    left: int
    active: Array | None = None


@dataclass(frozen=True, eq=False)
class Grid:
    """Targets on a grid, with the basis evaluated there."""

    targets: Array  # (n_points,): squared magnitudes f to stay above
    knots: Array  # (order,)
    phi: Array  # (n_points, order + 1)
    # (n_edges, order + 1): basis at DC, Nyquist and cuts, and at the grid point next to each: n and d may not fall by more than a
    # factor between them
    end: Array
    # (n_edges, order + 1): basis at DC, Nyquist and cuts, and at the grid point next to each: n and d may not fall by more than a
    # factor between them
    inner: Array
    nearest: Array  # (n_edges,)
    programs: Programs  # counted down; none is solved when none is left

    @classmethod
    def build(cls, tau: Array, targets: Array, knots: Array, cuts: Array, programs: Programs) -> Grid:
        """Evaluate the basis on a grid."""
        phi, programs.active = basis(tau, knots), None
        nearest = np.concatenate([[0], np.searchsorted(tau, cuts).clip(0, len(tau) - 1), [len(tau) - 1]])
        return cls(
            targets, knots, phi, basis(np.concatenate([[0.0], cuts, [np.inf]]), knots), phi[nearest], nearest, programs
        )

    def best(self, starts: Sequence[Array], enough: float) -> RationalMagnitude | None:
        """Return the best bound from several first denominators, shape (n_points,) each, or the first whose ratio is below `enough`."""
        found: RationalMagnitude | None = None
        ratio = np.inf
        for start in starts:
            rational, reached = self._iterate(start)
            if rational is not None and reached < ratio:
                found, ratio = rational, reached
            if ratio < enough:
                break
        return found

    def _iterate(self, scale: Array) -> tuple[RationalMagnitude | None, float]:
        scale, best, gamma = self._start(scale)
        for _ in range(_STEPS):
            if 10 * np.log10(gamma) < _EXACT_DB:
                break
            solution = self._improve(gamma, scale)
            if solution is None or not (self.phi @ solution[1] > 0).all():
                break
            rational, reached = self._lift(*solution)
            gain_db = 10 * np.log10(gamma / reached) if rational is not None else 0.0
            if gain_db <= 0:
                break
            best, gamma, scale = rational, reached, self.phi @ solution[1]
            if gain_db < _STALLED_DB:
                break
        return best, gamma

    def _start(self, scale: Array) -> tuple[Array, RationalMagnitude | None, float]:
        """First denominator, the first bound if any, and its ratio."""
        best, gamma, kept = None, float(self.targets.max() / self.targets.min()), scale
        for _ in range(_STARTS):
            solution = self._match(scale)
            if solution is None:
                break
            rational, reached = self._lift(*solution)
            settled = rational is not None and reached > gamma**0.8
            if rational is not None and reached < gamma:
                best, gamma, kept = rational, reached, self.phi @ solution[1]
            if settled or 10 * np.log10(gamma) < _EXACT_DB:
                break
            scale = np.maximum(np.abs(self.phi @ solution[1]), 1e-3 * scale)
        return kept, best, gamma

    def _lift(self, a: Array, b: Array) -> tuple[RationalMagnitude | None, float]:
        """Bound from coefficients, the numerator lifted onto the targets, with its true ratio; none where n or d is not positive."""
        n, d = self.phi @ a, self.phi @ b
        if not ((d > 0) & (n > 0)).all():
            return None, np.inf
        ratio = n / (self.targets * d)
        return RationalMagnitude(a / ratio.min(), b, self.knots), float(ratio.max() / ratio.min())

    def _match(self, scale: Array) -> tuple[Array, Array] | None:
        d = self.phi / scale[:, None]
        n = d / self.targets[:, None]
        return self._solve(n, d, [(n, -d, -1.0), (-n, d, -1.0)], scale)

    def _improve(self, gamma: float, scale: Array) -> tuple[Array, Array] | None:
        d = self.phi / scale[:, None]
        n = d / self.targets[:, None]
        return self._solve(n, d, [(n / gamma, -d, -1.0), (-n, d, 0.0)], scale)

    def _solve(
        self, n: Array, d: Array, blocks: Sequence[tuple[Array, Array, float]], scale: Array
    ) -> tuple[Array, Array] | None:
        """Minimise t over (a, b, t) under blocks of rows, the normalisation and the edges."""
        if self.programs.left <= 0:
            return None
        self.programs.left -= 1
        size = self.phi.shape[1]
        edge = (_EDGE * self.inner - self.end) / scale[self.nearest, None]
        none = np.zeros_like(edge)
        rows = [np.hstack([x, y, np.full((len(x), 1), t)]) for x, y, t in blocks]
        rows += [
            np.hstack([edge / self.targets[self.nearest, None], none, none[:, :1]]),
            np.hstack([none, edge, none[:, :1]]),
        ]
        with np.errstate(all="ignore"):
            unit = np.concatenate([1 / n.max(axis=0), 1 / d.max(axis=0), [1.0]])
            table = np.vstack(rows) * unit
            table /= np.abs(table).max(axis=1, keepdims=True)
        if not np.isfinite(table).all():  # a basis function that is zero on the grid
            return None
        found = solve(table, np.concatenate([np.zeros(size), d.mean(axis=0), [0.0]]) * unit, self.programs.active)
        if found is None:
            return None
        self.programs.active, x = found[1], found[0] * unit
        return x[:size], x[size : 2 * size]
