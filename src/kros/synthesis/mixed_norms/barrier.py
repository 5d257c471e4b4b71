r"""Interior-point method for small dense matrix inequalities: ``min c'x + x'Qx/2`` subject to ``F_k(x) = F_k0 + sum_i x_i F_ki >= 0``.

Conic solvers spend their time on one large sparse matrix for all cones. The problems of this package have few variables and small, dense
matrices; there the Newton step of the logarithmic barrier

.. math:: f(x) - \mu \sum_k \log\det F_k(x) - \mu \sum_i \log (r^2 - x_i^2)

costs one dense factorisation. It does not depend on the units of x nor on congruences of F. With ``D_k = F_k^{-1/2} dF_k F_k^{-1/2}`` along the
Newton step dx, the matrices ``mu F_k^{-1/2} (I - D_k) F_k^{-1/2}`` are feasible for the dual problem when ``D_k <= I``, so that

    f(x + dx) - mu sum_k (tr I - tr D_k^2)

is a lower bound of the optimum in the box ``|x_i| <= r``. The line search is exact: along a ray the barrier is a function of the eigenvalues of D_k.

References
----------
Y. Nesterov, A. Nemirovskii, *Interior-Point Polynomial Algorithms in Convex Programming*, SIAM 1994, chapters 2 and 6.
"""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass
from enum import Enum
from typing import Any

import numpy as np
import numpy.typing as npt

Array = npt.NDArray[Any]

_SHRINK, _CENTRED, _STEPS = 0.3, 1.0, 400
_BOX = 1e6


class Ending(str, Enum):
    """How it ended, and what to change.

    SOLVED
        The value is within the tolerance of the optimum.
    INFEASIBLE
        No point satisfies the inequalities (within the box); relax the level, or give the variables more room.
    TIME
        The time limit was reached; what is returned satisfies the inequalities, if there is anything.
    STALLED
        Rounding stopped the progress; what is returned satisfies the inequalities, if there is anything. Scale the problem.
    """

    SOLVED = "solved"
    INFEASIBLE = "infeasible"
    TIME = "time limit"
    STALLED = "no progress"


@dataclass(frozen=True, eq=False)
class Block:
    """Matrix inequalities of one size: constant (k, d, d) and coefficients (n, k, d, d), all symmetric, k of them."""

    constant: Array
    basis: Array

    def at(self, x: Array) -> Array:
        """Value of the matrices, shape (k, d, d)."""
        return self.constant + combine(x, self.basis)


def combine(x: Array, matrices: Array) -> Array:
    """``sum_i x_i M_i``; without BLAS, whose threads cost more than these sums where cores are shared."""
    return np.einsum("n,nf->f", x, matrices.reshape(len(x), -1)).reshape(matrices.shape[1:])


@dataclass(frozen=True, eq=False)
class Outcome:
    """Last point that satisfies all inequalities (None if there is none), its value, a lower bound of the optimum, and how it ended."""

    x: Array | None
    value: float
    lower: float
    ending: Ending
    steps: int


def minimise(
    c: Array,
    blocks: Sequence[Block],
    start: Array,
    *,
    Q: Array | None = None,
    rtol: float = 1e-5,
    time_limit_s: float = 20.0,
    box: float = _BOX,
) -> Outcome:
    """Minimise over the matrix inequalities."""
    end = time.perf_counter() + time_limit_s
    steps = 0
    if not _feasible(blocks, start, box):
        found = _find_feasible(blocks, start, end, box)
        if found.x is None:
            return found
        start, steps = found.x, found.steps
    return _follow(c, Q, blocks, start, rtol, end, np.full(len(c), box), steps)


def _feasible(blocks: Sequence[Block], x: Array, box: float) -> bool:
    return bool(np.abs(x).max(initial=0.0) < box) and all(
        np.linalg.eigvalsh(b.at(x)).min(initial=1.0) > 0 for b in blocks
    )


def _find_feasible(blocks: Sequence[Block], start: Array, end: float, box: float) -> Outcome:
    """Minimise t subject to ``F_k + t I >= 0``, ``t >= -1``, until t is negative enough."""
    n = len(start)
    lifted = [
        Block(
            b.constant, np.concatenate([b.basis, np.broadcast_to(np.eye(b.constant.shape[-1]), (1, *b.constant.shape))])
        )
        for b in blocks
    ]
    floor = np.zeros((n + 1, 1, 1, 1))
    floor[n] = 1.0
    worst = max(float(-np.linalg.eigvalsh(b.at(start)).min()) for b in blocks)
    inside = np.clip(start, -0.9 * box, 0.9 * box)
    goal = np.zeros(n + 1)
    goal[n] = 1.0
    point = np.append(inside, 1.5 * max(worst, 0.0) + 1.0)
    room = np.append(np.full(n, box), 10 * point[n])
    found = _follow(goal, None, [*lifted, Block(np.ones((1, 1, 1)), floor)], point, 1e-9, end, room, 0, stop_below=0.0)
    if found.x is not None and found.x[n] < 0 and _feasible(blocks, found.x[:n], box):
        return Outcome(found.x[:n], np.inf, -np.inf, found.ending, found.steps)
    ending = Ending.INFEASIBLE if found.lower > 0 else (Ending.TIME if found.ending is Ending.TIME else Ending.STALLED)
    return Outcome(None, np.inf, -np.inf, ending, found.steps)


def _follow(
    c: Array,
    Q: Array | None,
    blocks: Sequence[Block],
    x: Array,
    rtol: float,
    end: float,
    box: Array,
    steps: int,
    stop_below: float | None = None,
) -> Outcome:
    """Follow the central path; with `stop_below`, end at a centred point whose value lies clearly below it."""
    quadratic = np.zeros((len(x), len(x))) if Q is None else Q
    size = sum(b.constant.shape[0] * b.constant.shape[1] for b in blocks) + 2 * len(x)

    def value(point: Array) -> float:
        return float(c @ point + point @ quadratic @ point / 2)

    scaled = _Scaled.of(blocks, len(x))
    mu, lower, ending = max(abs(value(x)), 1e-3) / size * 10, -np.inf, Ending.STALLED
    while steps < _STEPS:
        steps += 1
        if time.perf_counter() > end:
            ending = Ending.TIME
            break
        try:
            gradient, hessian, roots = _derivatives(blocks, scaled, x, box)
            gradient, hessian = (c + quadratic @ x) / mu + gradient, quadratic / mu + hessian
            direction = -_solve(hessian, gradient)
        except np.linalg.LinAlgError:
            break
        eigenvalues = _spectrum(blocks, roots, x, direction, box)
        decrement = float(np.sqrt(max(-gradient @ direction, 0.0)))
        if not np.isfinite(decrement):
            break
        if eigenvalues.max(initial=0.0) <= 1:
            lower = max(lower, value(x + direction) - mu * (size - float(eigenvalues @ eigenvalues)))
        here = value(x)
        if stop_below is not None and here < stop_below - 1e-7 and decrement < 1:
            return Outcome(x, here, lower, Ending.SOLVED, steps)
        if stop_below is not None and lower > stop_below:
            return Outcome(x, here, lower, Ending.INFEASIBLE, steps)
        if here - lower <= rtol * max(abs(here), 1e-12):
            return Outcome(x, here, lower, Ending.SOLVED, steps)
        step = _line_search((c + quadratic @ x) @ direction / mu, direction @ quadratic @ direction / mu, eigenvalues)
        if (
            step * np.abs(direction).max(initial=0.0) <= 1e-15 * max(np.abs(x).max(initial=0.0), 1e-300)
            and decrement > _CENTRED
        ):
            break
        x = x + step * direction
        if decrement < _CENTRED:
            mu *= _SHRINK
    return Outcome(x, value(x), lower, ending, steps)


@dataclass(frozen=True, eq=False)
class _Scaled:
    """Coefficients of all matrices with the variables last, (d, d n) each, and memory for what every step makes of them: new memory costs more."""

    bases: list[Array]
    left: list[Array]  # of their shapes: R M_i
    lower: Array  # (entries, n): lower triangles of R M_i R', those of one matrix after the other

    @classmethod
    def of(cls, blocks: Sequence[Block], n: int) -> _Scaled:
        """Of blocks with n variables."""
        bases = [
            np.ascontiguousarray(np.moveaxis(m, 0, 2)).reshape(len(m[0]), -1)
            for b in blocks
            for m in np.swapaxes(b.basis, 0, 1)
        ]
        return cls(
            bases, [np.empty_like(m) for m in bases], np.empty((sum(len(m) * (len(m) + 1) // 2 for m in bases), n))
        )

    def along(self, roots: Sequence[Array]) -> tuple[Array, Array]:
        """Return ``sum_k tr D_ki`` and ``sum_k tr D_ki D_kj`` of ``D_ki = R_k M_ki R_k'``, for lower triangular roots R in the order of the matrices."""
        end, trace = 0, np.zeros(self.lower.shape[1])
        for root, basis, memory in zip(roots, self.bases, self.left, strict=True):
            left = np.matmul(root, basis, out=memory).reshape(*root.shape, -1)
            for row in range(len(root)):
                start, end = end, end + row + 1
                np.matmul(root[: row + 1, : row + 1], left[row, : row + 1], out=self.lower[start:end])
                trace += self.lower[end - 1]
                self.lower[end - 1] *= np.sqrt(0.5)  # counts once, all others twice
        return trace, 2 * (self.lower.T @ self.lower)


def _derivatives(blocks: Sequence[Block], scaled: _Scaled, x: Array, box: Array) -> tuple[Array, Array, list[Array]]:
    """Gradient and Hessian of the barrier, and the inverse Cholesky factors of all blocks."""
    roots = [np.linalg.inv(np.linalg.cholesky(block.at(x))) for block in blocks]
    trace, products = scaled.along([root for block in roots for root in block])
    gradient = 1 / (box - x) - 1 / (box + x) - trace
    return gradient, np.diag(1 / (box - x) ** 2 + 1 / (box + x) ** 2) + products, roots


def _solve(hessian: Array, gradient: Array) -> Array:
    """Newton direction in units in which the Hessian has a unit diagonal, with one step of refinement."""
    scale = 1 / np.sqrt(np.diag(hessian))
    scaled = hessian * scale[:, None] * scale + 1e-14 * np.eye(len(hessian))
    right = gradient * scale
    # LU: where cores are shared, the threads of a Cholesky factorisation of this size wait for each other.
    found = np.linalg.solve(scaled, right)
    found += np.linalg.solve(scaled, right - scaled @ found)
    return found * scale


def _spectrum(blocks: Sequence[Block], roots: Sequence[Array], x: Array, direction: Array, box: Array) -> Array:
    """Eigenvalues of ``F^-1/2 dF F^-1/2`` of all blocks and of the box."""
    parts = [direction / (box + x), -direction / (box - x)]
    for block, root in zip(blocks, roots, strict=True):
        change = root @ combine(direction, block.basis) @ root.swapaxes(-1, -2)
        parts.append(np.linalg.eigvalsh((change + change.swapaxes(-1, -2)) / 2).ravel())
    return np.concatenate(parts)


def _line_search(slope: float, curvature: float, eigenvalues: Array) -> float:
    """Minimiser over the step t of ``slope t + curvature t^2/2 - sum log(1 + t eigenvalue)``, by Newton's method, kept inside."""
    lowest = float(eigenvalues.min(initial=0.0))
    limit = np.inf if lowest >= 0 else -1 / lowest
    low, high, t = 0.0, limit, min(1.0, 0.9 * limit)
    for _ in range(50):
        ratio = eigenvalues / (1 + t * eigenvalues)
        first, second = slope + curvature * t - ratio.sum(), curvature + ratio @ ratio
        if first > 0:
            high = t
        else:
            low = t
        step = t - first / second
        t_new = step if low < step < high else (low + min(high, 4 * low + 1)) / 2
        if abs(t_new - t) <= 1e-3 * t_new:
            return float(min(t_new, 0.99 * limit))
        t = t_new
    return float(low or t)
