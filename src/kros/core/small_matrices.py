"""Products and largest singular values of many small matrices, on long vectors.

LAPACK takes stacks of 2 x 2 matrices one by one. Here the matrix axes come first, `(row, column, ...)`, and every entry
is a long vector over units and frequencies.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt

Array = npt.NDArray[Any]

_RANK = 1e-12  # columns closer to parallel than this are left to the SVD, which decides about the rank


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
    p, m = matrices.shape[:2]
    if min(p, m) > 2:
        return np.linalg.norm(entries_last(matrices), 2, axis=(-2, -1))
    return np.sqrt(sigma_max_squared(matrices))


def sigma_max_squared(matrices: Array) -> Array:
    """Return the squared largest singular value for `min(p, m) <= 2`."""
    columns = matrices if matrices.shape[1] <= matrices.shape[0] else np.swapaxes(matrices, 0, 1)
    first = squared(columns[:, 0]).sum(axis=0)
    if columns.shape[1] == 1:
        return first
    second = squared(columns[:, 1]).sum(axis=0)
    cross = np.einsum("i...,i...->...", np.conj(columns[:, 0]), columns[:, 1])
    half = (first - second) / 2
    return (first + second) / 2 + np.sqrt(half**2 + squared(cross))


def condition_number(matrices: Array) -> Array:
    """Return condition numbers of square matrices (..., n, n), shape (...); infinite where singular."""
    if matrices.shape[-1] != 2:
        return np.asarray(np.linalg.cond(matrices))
    entries = entries_first(matrices)
    det = np.abs(entries[0, 0] * entries[1, 1] - entries[0, 1] * entries[1, 0])
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.asarray(sigma_max_squared(entries) / det)


def pseudo_inverse_first(matrices: Array) -> Array:
    """Return pseudo-inverses, entries first, of matrices (..., p, m)."""
    if min(matrices.shape[-2:]) != 2:
        return entries_first(np.linalg.pinv(matrices))
    if matrices.shape[-2] < matrices.shape[-1]:
        return np.ascontiguousarray(np.swapaxes(pseudo_inverse_first(np.swapaxes(matrices, -1, -2)), 0, 1))
    columns = entries_first(matrices)
    g1, g2 = columns[:, 0], columns[:, 1]
    r11, size = np.sqrt(squared(g1).sum(axis=0)), np.sqrt(squared(g2).sum(axis=0))
    with np.errstate(all="ignore"):
        q1 = g1 / r11
        r12 = (np.conj(q1) * g2).sum(axis=0)
        v = g2 - q1 * r12
        again = (np.conj(q1) * v).sum(axis=0)
        v = v - q1 * again
        r22 = np.sqrt(squared(v).sum(axis=0))
        second = np.conj(v) / r22**2
        out = np.stack([(np.conj(q1) - (r12 + again) * second) / r11, second])
        weak = ~((r22 > _RANK * size) & (r11 > _RANK * size))
    if weak.any():
        out[:, :, weak] = entries_first(np.linalg.pinv(np.moveaxis(columns[:, :, weak], -1, 0)))
    return out
