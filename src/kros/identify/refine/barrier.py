"""A soft edge of stability: a search that only rejects unstable models stops where it first meets the edge, this one slides along it.

    cost = weight sum_i max(0, (|lambda_i| - 1 + guard) / guard)^2,      d|lambda| = Re[conj(lambda) / |lambda|  y^H dA x / (y^H x)]

with right and left eigenvectors x, y of A, and ``dA = (dV T^T)`` without its columns of inputs.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

Array = npt.NDArray[np.float64]


def stability_barrier(V: Array, T: Array, guard: float, weight: float) -> Array:
    """Return ``[J r]^T [J r]`` of the cost above, shape (problem, n p + 1, n p + 1), for V (problem, n, p) and T (p, p)."""
    problems, n, p = V.shape
    values, right = np.linalg.eig((V @ T.T)[..., :n])
    size = np.abs(values)
    excess = np.maximum(0.0, (size - 1 + guard) / guard)  # (problem, eigenvalue)
    left = np.linalg.pinv(right)  # rows y^H, with y^H x = 1
    turn = np.conj(values) / np.maximum(size, np.finfo(float).tiny)
    columns = np.swapaxes(right, -1, -2) @ T[:n]  # x^T of every eigenvalue, through dA = dV T^T
    slope = (turn[..., None, None] * left[..., :, None] * columns[..., None, :]).real.reshape(problems, n, n * p)
    J = np.where(excess[..., None] > 0, slope / guard, 0.0)
    rows = np.sqrt(weight) * np.concatenate([J, -excess[..., None]], axis=-1)
    return np.asarray(np.swapaxes(rows, -1, -2) @ rows)
