"""Small linear algebra that several layers need."""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt

Array = npt.NDArray[np.float64]


def adjoint(matrices: npt.NDArray[Any]) -> npt.NDArray[Any]:
    """Return the Hermitian transposes of matrices, shape (..., n, m)."""
    return np.asarray(np.conj(np.swapaxes(matrices, -1, -2)))


def floats(part: Any, *names: str) -> None:
    """Make fields of a frozen dataclass arrays of numbers, of one dimension at least."""
    for name in names:
        object.__setattr__(part, name, np.atleast_1d(np.asarray(getattr(part, name), dtype=float)))


def radius_text(value: float) -> str:
    """Return a spectral radius as text, with enough digits to differ from one, for example ``1 - 2.5e-08``."""
    distance = 1 - value
    if distance == 0 or not 0 < abs(distance) < 1e-4:
        return f"{value:.6g}"
    return f"1 {'-' if distance > 0 else '+'} {abs(distance):.2g}"


def qr_triangle(matrix: Array) -> Array:
    """Return the triangular factor R of a QR decomposition, batched; shape (..., min(rows, n), n)."""
    return np.asarray(np.linalg.qr(matrix, mode="r"))


def least_squares(regressors: Array, values: Array, rcond: float | None = None) -> Array:
    """Return the smallest least-squares X of ``regressors X = values``, every regressor in units of its size."""
    largest = np.abs(regressors).max(axis=0, initial=0.0)
    largest[largest == 0] = 1.0
    size = largest * np.sqrt(np.mean((regressors / largest) ** 2, axis=0))
    size[size == 0] = 1.0
    return np.asarray(np.linalg.lstsq(regressors / size, values, rcond=rcond)[0] / size[:, None])


def balanced_size(A: Array) -> Array:
    """Sizes of the states, powers of two, in which rows and columns of A are of alike size, shape (n,)."""
    from scipy.linalg import matrix_balance

    return np.asarray(matrix_balance(A, permute=False, separate=True)[1][0]) if A.size else np.ones(len(A))


def balancing(
    R: npt.NDArray[Any], S: npt.NDArray[Any], negligible: float = 0.0
) -> tuple[npt.NDArray[Any], npt.NDArray[Any], npt.NDArray[Any]]:
    """Balance the Gramians ``R R'`` and ``S S'``: left, right, ``left @ right = I``, and the Hankel singular values.

    The balanced state is ``left x``. Values below a share of the largest are `negligible`.
    """
    U, values, Vh = np.linalg.svd(S.T @ R, full_matrices=False)
    k = int(np.sum(values > negligible * values.max(initial=0.0)))
    root = np.sqrt(values[:k])
    return (U[:, :k] / root).T @ S.T, R @ Vh[:k].T / root, values[:k]


def solve_balanced(A: Array, values: Array, rcond: float | None = None) -> Array:
    """Return X that makes ``A X - values`` smallest for a square A between states, which is balanced first."""
    size = balanced_size(A)
    return np.asarray(np.linalg.lstsq(A * size / size[:, None], values / size[:, None], rcond=rcond)[0] * size[:, None])
