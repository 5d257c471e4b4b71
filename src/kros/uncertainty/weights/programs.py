r"""The linear programs behind `magnitude`: iterations towards the best rational bound on a grid, for fixed knots.

Two iterations, both in the coefficients a and b of n and d, with `e` the denominator of the step before:

    start (Sanathanan-Koerner):  minimise t  s.t.  |n_i / f_i - d_i| <= t e_i
    improve (Dinkelbach):        minimise t  s.t.  d_i <= n_i / f_i,  n_i / (gamma f_i) - d_i <= t e_i

and mean(d / e) = 1.

The first needs no guess of the ratio gamma and is exact at once for data of that order; the second converges
superlinearly to the global optimum from any bound. Rows are relative to the denominator, columns to their largest
entry, because programs are solved to absolute tolerances.

Programs of a dozen unknowns are solved by the dual simplex method on dense rows, each from the active rows of the one
before: same optima as SciPy's HiGHS to 1e-5 dB, in a sixth of its time (108 fits of orders 2 to 4).

References
----------
C. E. Lemke, "The dual method of solving the linear programming problem", Naval Research Logistics Quarterly 1 (1954)
36-47.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from .rational import RationalMagnitude, basis

Array = npt.NDArray[Any]

_EDGE = 1e-4  # how far n and d may fall between the ends of the grid and DC or Nyquist
_STARTS, _STEPS = 10, 12  # limits of the two iterations, which settle in three to six
_EXACT, _STALLED = 10**1e-5, 10**5e-4  # ratios of squared magnitudes, 1e-4 and 5e-3 dB, that count as one
_FAR = 1e8  # rows are of size one, and solutions at most some thousands
_EXCEEDED, _ACROSS = 1e-10, 1e-11  # rounding of rows


@dataclass(eq=False)
class Grid:
    """Targets on a grid, with the basis evaluated there; `active` are the active rows of the last program."""

    targets: Array  # (n_points,): squared magnitudes f to stay above
    knots: Array  # (order,)
    phi: Array  # (n_points, order + 1)
    edge: Array  # (n_edges, order + 1): rows that keep n and d from falling at DC, Nyquist and cuts
    nearest: Array  # (n_edges,): grid points next to these
    active: Array | None = None

    @classmethod
    def of(cls, tau: Array, targets: Array, knots: Array, cuts: Array) -> Grid:
        """Evaluate the basis on a grid."""
        phi = basis(tau, knots)
        nearest = np.concatenate([[0], np.searchsorted(tau, cuts).clip(0, len(tau) - 1), [len(tau) - 1]])
        edge = _EDGE * phi[nearest] - basis(np.concatenate([[0.0], cuts, [np.inf]]), knots)
        return cls(targets, knots, phi, edge, nearest)

    def best(self, starts: Sequence[Array]) -> RationalMagnitude | None:
        """Return the best bound from several first denominators, shape (n_points,) each."""
        reached = [self._improved(*self._started(scale)) for scale in starts]
        return min(reached, key=lambda pair: pair[1])[0]

    def _improved(
        self, scale: Array, best: RationalMagnitude | None, gamma: float
    ) -> tuple[RationalMagnitude | None, float]:
        """Return the bound and its ratio at the end of the second iteration."""
        for _ in range(_STEPS):
            if gamma < _EXACT:
                break
            rational, ratio = self._lifted(self._solved(scale, gamma))
            if rational is None or ratio >= gamma:
                break
            stalled = gamma / ratio < _STALLED
            best, gamma, scale = rational, ratio, self.phi @ rational.denominator
            if stalled:
                break
        return best, gamma

    def _started(self, scale: Array) -> tuple[Array, RationalMagnitude | None, float]:
        """Return a denominator, the first bound if any, and its ratio."""
        best, gamma, denominator = None, float(self.targets.max() / self.targets.min()), scale
        for _ in range(_STARTS):
            solution = self._solved(scale)
            if solution is None:
                break
            rational, ratio = self._lifted(solution)
            settled = rational is not None and ratio > gamma**0.8
            if rational is not None and ratio < gamma:
                best, gamma, denominator = rational, ratio, self.phi @ solution[1]
            if settled or gamma < _EXACT:
                break
            scale = np.maximum(np.abs(self.phi @ solution[1]), 1e-3 * scale)
        return denominator, best, gamma

    def _lifted(self, solution: tuple[Array, Array] | None) -> tuple[RationalMagnitude | None, float]:
        """Return the bound, lifted onto the targets, and its ratio; None where n or d is not positive."""
        if solution is None:
            return None, np.inf
        a, b = solution
        n, d = self.phi @ a, self.phi @ b
        if not ((d > 0) & (n > 0)).all():
            return None, np.inf
        ratio = n / (self.targets * d)
        return RationalMagnitude(a / ratio.min(), b, self.knots), float(ratio.max() / ratio.min())

    def _solved(self, scale: Array, gamma: float | None = None) -> tuple[Array, Array] | None:
        """Minimise t over (a, b, t) under the rows of the first iteration, or of the second from a ratio."""
        d = self.phi / scale[:, None]
        n = d / self.targets[:, None]
        edge, size = self.edge / scale[self.nearest, None], self.phi.shape[1]
        none = np.zeros_like(edge)
        one, both = np.ones((len(n), 1)), gamma is None
        rows = [np.hstack([n / (gamma or 1.0), -d, -one]), np.hstack([-n, d, -one if both else 0 * one])]
        rows.append(np.hstack([edge / self.targets[self.nearest, None], none, none[:, :1]]))
        rows.append(np.hstack([none, edge, none[:, :1]]))
        with np.errstate(all="ignore"):
            unit = np.concatenate([1 / n.max(axis=0), 1 / d.max(axis=0), [1.0]])
            table = np.vstack(rows) * unit
            table /= np.abs(table).max(axis=1, keepdims=True)
        if not np.isfinite(table).all():  # a basis function that is zero on the grid
            return None
        norm = np.concatenate([np.zeros(size), d.mean(axis=0), [0.0]]) * unit
        solution = minimised(table, norm, self.active)
        if solution is None:
            return None
        self.active, x = solution[1], solution[0] * unit
        return x[:size], x[size : 2 * size]


def minimised(A: Array, g: Array, active: Array | None = None) -> tuple[Array, Array] | None:
    """Return x and its active rows: minimise the last of x under `A x <= 0`, `g x = 1`."""
    n = len(g)
    bounds = np.delete(-np.eye(n), int(np.abs(g[:-1]).argmax()), axis=0)
    begin = np.vstack([bounds, g]), np.append(np.full(n - 1, _FAR), 1.0), np.full(n - 1, -1)
    for vertex in ([] if active is None else [_near(A, g, active)]) + [begin]:
        try:
            solution = _stepped(A, *vertex)
        except np.linalg.LinAlgError:
            continue
        if solution is not None:
            return solution
    return None


def _near(A: Array, g: Array, active: Array) -> tuple[Array, Array, Array]:
    """Return active rows, and the opposite ones far away where multipliers are negative."""
    M, names = np.vstack([A[active], g]), active.copy()
    try:
        negative = np.flatnonzero(np.linalg.inv(M)[-1, :-1] > 0)
    except np.linalg.LinAlgError:
        negative = np.arange(0)
    M[negative] *= -1
    names[negative] = -1
    return M, np.append(np.where(names < 0, _FAR, 0.0), 1.0), names


def _stepped(A: Array, M: Array, right: Array, names: Array) -> tuple[Array, Array] | None:
    """Step from the vertex `M x = right`, whose multipliers are positive, until no row is exceeded."""
    for _ in range(50 * len(M)):
        inverse = np.linalg.inv(M)
        x = inverse @ right
        exceeded = A @ x
        worst = int(exceeded.argmax())
        if not exceeded[worst] > _EXCEEDED:
            return None if (names < 0).any() or not np.isfinite(x).all() else (x, names)
        share = (A[worst] @ inverse)[:-1]
        leaving = np.flatnonzero(share > _ACROSS)
        if not leaving.size:
            return None
        first = leaving[(np.maximum(-inverse[-1, leaving], 0.0) / share[leaving]).argmin()]
        M[first], right[first], names[first] = A[worst], 0.0, worst
    return None
