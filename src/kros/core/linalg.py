"""Small linear algebra that several layers need."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

Array = npt.NDArray[np.float64]


def qr_triangle(matrix: Array) -> Array:
    """Return the triangular factor R of a QR decomposition, batched; shape (..., min(rows, n), n)."""
    return np.asarray(np.linalg.qr(matrix, mode="r"))
