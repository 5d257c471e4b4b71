"""Small linear algebra that several layers need."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

Array = npt.NDArray[np.float64]


def radius_text(value: float) -> str:
    """Return a spectral radius, or the size of a pole, with as many digits as tell it from one, for example ``1 - 2.5e-08``."""
    distance = 1 - value
    if distance == 0 or not 0 < abs(distance) < 1e-4:
        return f"{value:.6g}"
    return f"1 {'-' if distance > 0 else '+'} {abs(distance):.2g}"


def qr_triangle(matrix: Array) -> Array:
    """Return the triangular factor R of a QR decomposition, batched; shape (..., min(rows, n), n)."""
    return np.asarray(np.linalg.qr(matrix, mode="r"))
