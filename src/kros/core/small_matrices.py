"""Products and largest singular values of many small matrices, on long vectors.

LAPACK takes stacks of 2 x 2 matrices one by one. Here the matrix axes come first, `(row, column, ...)`, and every entry
is a long vector over units and frequencies.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt

Array = npt.NDArray[Any]


def entries_first(matrices: Array) -> Array:
    """Move the matrix axes to the front: (..., p, m) to (p, m, ...), contiguous."""
    return np.ascontiguousarray(np.moveaxis(matrices, (-2, -1), (0, 1)))


def entries_last(matrices: Array) -> Array:
    """Move the matrix axes to the back: (p, m, ...) to (..., p, m)."""
    return np.moveaxis(matrices, (0, 1), (-2, -1))


def multiply(left: Array, right: Array) -> Array:
    """Multiply entries-first matrices: (p, r, ...) times (r, m, ...), broadcast over the rest."""
    return np.asarray(np.einsum("ik...,kj...->ij...", left, right))


def adjoint(matrices: Array) -> Array:
    """Return the conjugate transposes of entries-first matrices."""
    return np.conj(np.swapaxes(matrices, 0, 1))


def squared(values: Array) -> Array:
    """Return the squared modulus."""
    return values.real**2 + values.imag**2 if np.iscomplexobj(values) else values**2


def sigma_max(matrices: npt.ArrayLike) -> Array:
    """Return the largest singular value, shape (...), of matrices of shape (..., p, m).

    Examples
    --------
    >>> from kros.uncertainty import sigma_max
    >>> sigma_max([[[3.0, 0.0], [0.0, 4.0]], [[0.0, 1.0], [0.0, 0.0]]]).tolist()
    [4.0, 1.0]
    """
    return sigma_max_first(entries_first(np.asarray(matrices)))


def sigma_max_first(matrices: Array) -> Array:
    """Return the largest singular value of entries-first matrices (p, m, ...), shape (...)."""
    columns = matrices if matrices.shape[1] <= matrices.shape[0] else np.swapaxes(matrices, 0, 1)
    if columns.shape[1] > 2:
        return np.linalg.norm(entries_last(columns), 2, axis=(-2, -1))
    first = squared(columns[:, 0]).sum(axis=0)
    if columns.shape[1] == 1:
        return np.sqrt(first)
    second = squared(columns[:, 1]).sum(axis=0)
    cross = np.einsum("i...,i...->...", np.conj(columns[:, 0]), columns[:, 1])
    return np.sqrt((first + second) / 2 + np.sqrt((first - second) ** 2 / 4 + squared(cross)))
