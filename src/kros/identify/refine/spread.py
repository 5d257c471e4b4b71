"""How far the models of a population are apart, as the uncertainty of the population will count it."""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt

from ...core.small_matrices import entries_first, multiply, pseudo_inverse_first, sigma_max_first
from .metric import unit_circle
from .minimax import smallest_largest

Array = npt.NDArray[Any]


def peak_residual_db(A: Array, B: Array, points: int = 200) -> float:
    """Return the peak of ``G^+ (G_nominal - G)`` for the nominal unit that makes it smallest, channels over ranges."""
    if len(A) < 2:
        return float("nan")
    z = unit_circle(points)
    G = np.linalg.solve(z[:, None, None] * np.eye(A.shape[-1]) - A[:, None], B[:, None] + 0j)
    inverse, G, every = pseudo_inverse_first(G), entries_first(G), np.arange(points)  # (m, n, unit, frequency)

    def bound_of(row: int) -> tuple[Array, Array]:
        sizes = sigma_max_first(multiply(inverse, G[:, :, row, None] - G))
        return sizes.max(axis=0), sizes.argmax(axis=0)

    def against(rows: Array, witness: Array) -> Array:
        farthest = G[:, :, None, witness, every]
        return sigma_max_first(multiply(inverse[:, :, None, witness, every], G[:, :, rows] - farthest))

    if np.array_equal(G, np.broadcast_to(G[:, :, :1], G.shape)):
        return -np.inf
    _, _, peaks, exact = smallest_largest((len(A), points), 0, bound_of, against, lambda bound: bound.max(axis=-1))
    with np.errstate(divide="ignore"):
        return float(20 * np.log10(peaks[exact].min()))
