"""Levenberg-Marquardt for many small problems side by side, with damping, acceptance and a constraint of their own for each."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

Array = npt.NDArray[np.float64]
_START, _LEAST, _MOST = 1e-3, 1e-9, 1e8


@dataclass(frozen=True, eq=False)
class Solution:
    """Where the search ended.

    Parameters
    ----------
    V : ndarray, shape (problem, rows, columns)
    matrix : ndarray, shape (problem, P + 1, P + 1)
        ``[J r]^T [J r]`` there.
    iterations : int
    converged : ndarray of bool, shape (problem,)
        Whether the last accepted step gained less than was asked for, or no damping gave a better point.
    """

    V: Array
    matrix: Array
    iterations: int
    converged: npt.NDArray[np.bool_]

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
    evaluate: Callable[[Array], Array],
    admissible: Callable[[Array], npt.NDArray[np.bool_]],
    V: Array,
    iterations: int,
    least_gain: float,
) -> Solution:
    """Minimise the squared residuals of every problem.

    Parameters
    ----------
    evaluate : callable
        Returns ``[J r]^T [J r]``, (problem, P + 1, P + 1), at V; r is data minus model and J the model's derivative.
    admissible : callable
        Which V may be taken at all, shape (problem,).
    V : ndarray, shape (problem, rows, columns)
        Admissible start.
    iterations : int
    least_gain : float
        Relative decrease of the cost at which a problem is done.

    Returns
    -------
    Solution
    """
    matrix = evaluate(V)
    mu = np.full(len(V), _START)
    done = np.zeros(len(V), dtype=bool)
    used = 0
    while used < iterations and not done.all():
        trial = V + _step(matrix, mu).reshape(V.shape)
        allowed = admissible(trial) & ~done
        found = evaluate(np.where(allowed[:, None, None], trial, V))
        better = allowed & (found[:, -1, -1] < matrix[:, -1, -1])
        small = found[:, -1, -1] >= (1 - least_gain) * matrix[:, -1, -1]
        done |= (better & small & (mu <= _START)) | (~better & (mu >= _MOST)) | (matrix[:, -1, -1] == 0)
        V = np.where(better[:, None, None], trial, V)
        matrix = np.where(better[:, None, None], found, matrix)
        mu = np.clip(np.where(better, mu / 10, mu * 10), _LEAST, _MOST)
        used += 1
    return Solution(V, matrix, used, done)


def _step(matrix: Array, mu: Array) -> Array:
    """Solve the damped normal equations in parameters scaled to a unit diagonal."""
    fine = np.asarray(np.isfinite(matrix).all(axis=(1, 2)))  # a run that diverges gives no direction
    H = np.where(fine[:, None, None], matrix[:, :-1, :-1], np.eye(matrix.shape[-1] - 1))
    g = np.where(fine[:, None], matrix[:, :-1, -1], 0.0)
    diagonal = np.diagonal(H, axis1=1, axis2=2)
    scale = 1 / np.sqrt(np.maximum(diagonal, np.finfo(float).eps ** 2 * diagonal.max(axis=1, keepdims=True) + np.finfo(float).tiny))
    scaled = H * scale[:, :, None] * scale[:, None, :] + mu[:, None, None] * np.eye(H.shape[-1])
    return np.asarray(np.linalg.solve(scaled, (g * scale)[..., None])[..., 0] * scale)
