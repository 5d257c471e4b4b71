r"""Interior-point method for small dense matrix inequalities.

It solves ``min c'x`` subject to ``F_k(x) = F_k0 + sum_i x_i F_ki >= 0``.

Conic solvers spend their time on one large sparse matrix for all cones. The problems of this package have few variables
and small, dense matrices. There the Newton step of the logarithmic barrier

.. math:: f(x) - \mu \sum_k \log\det F_k(x) - \mu \sum_i \log (r^2 - x_i^2)

costs one dense factorisation. It does not depend on the units of x nor on congruences of F. With ``D_k = F_k^{-1/2}
dF_k F_k^{-1/2}`` along the Newton step dx, the matrices ``mu F_k^{-1/2} (I - D_k) F_k^{-1/2}`` are feasible for the
dual problem when ``D_k <= I``, so that

    f(x + dx) - mu sum_k (tr I - tr D_k^2)

is a lower bound of the optimum in the box ``|x_i| <= r``. The line search is exact: along a ray the barrier is a
function of the eigenvalues of D_k.

References
----------
Y. Nesterov, A. Nemirovskii, *Interior-Point Polynomial Algorithms in Convex Programming*, SIAM 1994, chapters 2 and 6.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from enum import Enum

import numpy as np
from numpy.linalg import LinAlgError, cholesky, eigvalsh, inv, solve

from ...core import EPS, ITERATED, ROUNDING, TINY, AnyArray, frozen

_SHRINK, _CENTRED = 0.3, 1.0  # of mu once the decrement is below the second


class Ending(str, Enum):
    """How it ended; a point, if any, satisfies the inequalities unless they are infeasible within the box."""

    SOLVED = "solved"
    INFEASIBLE = "infeasible"
    STEPS = "limit of steps"
    STALLED = "no progress"


@frozen
class Block:
    """Matrix inequalities of one size: constant (k, d, d) and coefficients (n, k, d, d), all symmetric, k of them."""

    constant: AnyArray
    basis: AnyArray

    def at(self, x: AnyArray) -> AnyArray:
        """Value of the matrices, shape (k, d, d)."""
        return self.constant + self.along(x)

    def along(self, x: AnyArray) -> AnyArray:
        """``sum_i x_i M_i``."""
        return np.tensordot(x, self.basis, 1)


@frozen
class Outcome:
    """Last point that satisfies all inequalities, if any, its value, a lower bound of the optimum, and how it ended."""

    x: AnyArray | None
    value: float
    lower: float
    ending: Ending


def minimise(
    c: AnyArray,
    blocks: Sequence[Block],
    start: AnyArray,
    *,
    rtol: float = 1e-5,
    steps: int = 400,
) -> Outcome:
    """Minimise over the matrix inequalities, with so many Newton steps at most, to a feasible point and from there."""
    programme = _Programme(c, blocks, np.full(len(c), 1e6))
    if not programme.holds(start):
        feasible = _find_feasible(programme, start, steps)
        if feasible.x is None:
            return feasible
        start = feasible.x
    return _follow(programme, start, rtol, steps)


def _find_feasible(programme: _Programme, start: AnyArray, steps: int) -> Outcome:
    """Minimise t subject to ``F_k + t I >= 0``, ``t >= -1``, until t is negative enough."""
    n, goal = len(start), np.append(np.zeros(len(start)), 1.0)
    lifted = [Block(np.ones((1, 1, 1)), goal[:, None, None, None])]
    for block in programme.blocks:
        unit = np.broadcast_to(np.eye(block.constant.shape[-1]), (1, *block.constant.shape))
        lifted.append(Block(block.constant, np.concatenate([block.basis, unit])))
    worst = max(-float(eigvalsh(block.at(start)).min()) for block in programme.blocks)
    inside = np.clip(start, -0.9 * programme.box, 0.9 * programme.box)
    point = np.append(inside, 1.5 * max(worst, 0.0) + 1.0)
    extended = _Programme(goal, lifted, np.append(programme.box, 10 * point[n]))
    outcome = _follow(extended, point, ITERATED, steps, stop_below=0.0)
    if outcome.x is not None and outcome.x[n] < 0 and programme.holds(outcome.x[:n]):
        return replace(outcome, x=outcome.x[:n])
    ending = Ending.STEPS if outcome.ending is Ending.STEPS else Ending.STALLED
    return Outcome(None, np.inf, -np.inf, Ending.INFEASIBLE if outcome.lower > 0 else ending)


def _follow(programme: _Programme, x: AnyArray, rtol: float, steps: int, stop_below: float = -np.inf) -> Outcome:
    """Follow the central path from a point inside; with `stop_below` to a centred point clearly below it."""
    size = programme.size
    mu, lower, ending = max(abs(programme.value(x)), 1e-3) / size * 10, -np.inf, Ending.STALLED
    for _ in range(steps):
        try:
            gradient, hessian, roots = programme.derivatives(x)
            gradient = programme.c / mu + gradient
            direction = -_solve(hessian, gradient)
        except LinAlgError:
            break
        eigenvalues = programme.spectrum(roots, x, direction)
        decrement = float(np.sqrt(max(-float(gradient @ direction), 0.0)))
        if not np.isfinite(decrement):
            break
        if eigenvalues.max(initial=0.0) <= 1:
            lower = max(lower, programme.value(x + direction) - mu * (size - float(eigenvalues @ eigenvalues)))
        here, proven = programme.value(x), np.isfinite(stop_below) and lower > stop_below
        if proven or here - lower <= rtol * max(abs(here), ROUNDING) or (here < stop_below - 1e-7 and decrement < 1):
            return Outcome(x, here, lower, Ending.INFEASIBLE if proven else Ending.SOLVED)
        step = _line_search(float(programme.c @ direction) / mu, eigenvalues)
        moved = step * np.abs(direction).max(initial=0.0)
        if moved <= 4 * EPS * max(np.abs(x).max(initial=0.0), TINY) and decrement > _CENTRED:
            break
        x = x + step * direction
        mu = mu * _SHRINK if decrement < _CENTRED else mu
    else:
        ending = Ending.STEPS
    return Outcome(x, programme.value(x), lower, ending)


@frozen
class _Programme:
    """``min c'x`` subject to the blocks and ``|x_i| <= box_i``."""

    c: AnyArray
    blocks: Sequence[Block]
    box: AnyArray

    @property
    def size(self) -> int:
        """Number of logarithms in the barrier."""
        return sum(b.constant.shape[0] * b.constant.shape[1] for b in self.blocks) + 2 * len(self.c)

    def value(self, x: AnyArray) -> float:
        """Objective."""
        return float(self.c @ x)

    def holds(self, x: AnyArray) -> bool:
        """Whether a point satisfies all inequalities."""
        inside = bool((np.abs(x) < self.box).all())
        return inside and all(eigvalsh(b.at(x)).min(initial=1.0) > 0 for b in self.blocks)

    def derivatives(self, x: AnyArray) -> tuple[AnyArray, AnyArray, list[AnyArray]]:
        """Gradient ``-tr D_i``, Hessian ``tr D_i D_j`` with ``D_i = R M_i R'``, and the inverse Cholesky factors R."""
        above, below = 1 / (self.box - x), 1 / (self.box + x)
        gradient, hessian, roots = above - below, np.diag(above**2 + below**2), []
        for block in self.blocks:
            root = inv(cholesky(block.at(x)))
            D = root @ block.basis @ root.swapaxes(-1, -2)
            gradient = gradient - np.trace(D, axis1=-2, axis2=-1).sum(axis=1)
            row, column = np.tril_indices(D.shape[-1])  # of symmetric matrices; entries below the diagonal count twice
            flat = (D[..., row, column] * np.where(row > column, np.sqrt(2.0), 1.0)).reshape(len(x), -1)
            hessian = hessian + flat @ flat.T
            roots.append(root)
        return gradient, hessian, roots

    def spectrum(self, roots: Sequence[AnyArray], x: AnyArray, direction: AnyArray) -> AnyArray:
        """Eigenvalues of ``F^-1/2 dF F^-1/2`` of all blocks and of the box."""
        parts = [direction / (self.box + x), -direction / (self.box - x)]
        for block, root in zip(self.blocks, roots, strict=True):
            change = root @ block.along(direction) @ root.swapaxes(-1, -2)
            parts.append(eigvalsh((change + change.swapaxes(-1, -2)) / 2).ravel())
        return np.concatenate(parts)


def _solve(hessian: AnyArray, gradient: AnyArray) -> AnyArray:
    """Newton direction in units in which the Hessian has a unit diagonal, with one step of refinement."""
    scale = 1 / np.sqrt(np.diag(hessian))
    scaled = hessian * scale[:, None] * scale + 100 * EPS * np.eye(len(hessian))
    right = gradient * scale
    direction = solve(scaled, right)
    direction += solve(scaled, right - scaled @ direction)
    return direction * scale


def _line_search(slope: float, eigenvalues: AnyArray) -> float:
    """Minimise ``slope t - sum log(1 + t eigenvalue)`` over the step t."""
    from scipy.optimize import minimize_scalar

    limit = 1 / max(-float(eigenvalues.min(initial=0.0)), 0.01)
    result = minimize_scalar(
        lambda t: slope * t - float(np.log(np.maximum(1 + t * eigenvalues, TINY)).sum()),
        bounds=(0.0, limit),
        method="bounded",
        options={"xatol": 1e-3},
    )
    return float(result.x)
