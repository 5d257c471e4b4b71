"""Levenberg-Marquardt for many small problems side by side, with damping, acceptance and a constraint of their own for each."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

Array = npt.NDArray[np.float64]
Evaluate = Callable[[Array], Array]
_START, _LEAST, _MOST = 1e-3, 1e-9, 1e8
_NARROWED = 0.75  # of the problems at work: their data are copied where fewer are left


@dataclass(frozen=True, eq=False)
class Solution:
    """Where the search ended."""

    V: Array  # (problem, rows, columns)
    matrix: Array  # (problem, P + 1, P + 1)
    iterations: int
    converged: npt.NDArray[np.bool_]  # (problem,)

    @property
    def cost(self) -> Array:
        """Sum of squared residuals, shape (problem,)."""
        return self.matrix[:, -1, -1]

    def updated(self, rows: npt.NDArray[np.int64], part: Solution) -> Solution:
        """Return the solution with some problems as another search left them."""
        V, matrix, converged = self.V.copy(), self.matrix.copy(), self.converged.copy()
        V[rows], matrix[rows], converged[rows] = part.V, part.matrix, part.converged
        return Solution(V, matrix, self.iterations + part.iterations, converged)


def minimise(
    evaluate: Evaluate,
    admissible: Callable[[Array], npt.NDArray[np.bool_]],
    V: Array,
    iterations: int,
    least_gain: float,
    narrowed: Callable[[npt.NDArray[np.int64]], Evaluate] | None = None,
) -> Solution:
    """Minimise the squared residuals of every problem; V (problem, rows, columns)."""
    V, matrix = V.copy(), evaluate(V)
    mu = np.full(len(V), _START)
    done = np.zeros(len(V), dtype=bool)
    rows, used = np.arange(len(V)), 0
    while used < iterations and not done.all():
        if narrowed is not None and np.count_nonzero(~done) <= _NARROWED * len(rows):
            rows = np.flatnonzero(~done)
            evaluate = narrowed(rows)
        now, before, damping = V[rows], matrix[rows], mu[rows]
        trial = now + _step(before, damping).reshape(now.shape)
        allowed = admissible(trial) & ~done[rows]
        found = evaluate(np.where(allowed[:, None, None], trial, now))
        cost, last = found[:, -1, -1], before[:, -1, -1]
        better = allowed & (cost < last)
        small = cost >= (1 - least_gain) * last
        done[rows] |= (better & small & (damping <= _START)) | (~better & (damping >= _MOST)) | (last == 0)
        V[rows], matrix[rows] = (
            np.where(better[:, None, None], trial, now),
            np.where(better[:, None, None], found, before),
        )
        mu[rows] = np.clip(np.where(better, damping / 10, damping * 10), _LEAST, _MOST)
        used += 1
    return Solution(V, matrix, used, done)


def _step(matrix: Array, mu: Array) -> Array:
    """Solve the damped normal equations in parameters scaled to a unit diagonal."""
    fine = np.asarray(np.isfinite(matrix).all(axis=(1, 2)))  # a run that diverges gives no direction
    H = np.where(fine[:, None, None], matrix[:, :-1, :-1], np.eye(matrix.shape[-1] - 1))
    g = np.where(fine[:, None], matrix[:, :-1, -1], 0.0)
    diagonal = np.diagonal(H, axis1=1, axis2=2)
    scale = 1 / np.sqrt(
        np.maximum(diagonal, np.finfo(float).eps ** 2 * diagonal.max(axis=1, keepdims=True) + np.finfo(float).tiny)
    )
    scaled = H * scale[:, :, None] * scale[:, None, :] + mu[:, None, None] * np.eye(H.shape[-1])
    return np.asarray(np.linalg.solve(scaled, (g * scale)[..., None])[..., 0] * scale)
