"""How far the models of a population are apart, as the uncertainty of the population will count it."""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt

from ...core.small_matrices import entries_first, multiply, pseudo_inverse_first, sigma_max_first
from .minimax import smallest_largest

Array = npt.NDArray[Any]
_POINTS = 200
_AT_ONCE = 500  # units
_DECADES_BELOW_NYQUIST = 6


def peak_residual_db(A: Array, B: Array, output_scale: Array, input_scale: Array, points: int = _POINTS) -> float:
    """Return the peak of the inverse input multiplicative residual ``G^+ (G_nominal - G)`` for the nominal unit that makes it smallest."""
    if len(A) < 2:
        return float("nan")
    z = np.exp(1j * np.pi * np.logspace(-_DECADES_BELOW_NYQUIST, 0, points))
    G = (
        np.linalg.solve(z[:, None, None] * np.eye(A.shape[-1]) - A[:, None], B[:, None] + 0j)
        * input_scale
        / output_scale[:, None]
    )
    inverse, G, every = (
        pseudo_inverse_first(G),
        entries_first(G),
        np.arange(points),
    )  # (m, n, unit, frequency) and (n, m, ...)
    n_units = len(A)

    def bound_of(row: int) -> tuple[Array, Array]:
        largest, who = np.full(points, -1.0), np.zeros(points, int)
        for start in range(0, n_units, _AT_ONCE):
            some = slice(start, start + _AT_ONCE)
            sizes = sigma_max_first(multiply(inverse[:, :, some], G[:, :, row, None] - G[:, :, some]))
            here, worst = sizes.max(axis=0), sizes.argmax(axis=0) + start
            largest, who = np.where(here > largest, here, largest), np.where(here > largest, worst, who)
        return largest, who

    def against(rows: Array, witness: Array) -> Array:
        return sigma_max_first(
            multiply(inverse[:, :, None, witness, every], G[:, :, rows] - G[:, :, None, witness, every])
        )

    if np.array_equal(G, np.broadcast_to(G[:, :, :1], G.shape)):
        return -np.inf
    _, _, peaks, exact = smallest_largest((n_units, points), 0, bound_of, against, lambda bound: bound.max(axis=-1))
    with np.errstate(divide="ignore"):
        return float(20 * np.log10(peaks[exact].min()))
