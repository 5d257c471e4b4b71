"""Small linear algebra that several layers need.

Many small matrices have their axes first, `(row, column, ...)`: LAPACK takes stacks of 2 x 2 matrices one by one.
"""

import numpy as np

from .arrays import AnyArray, Array, ArrayLike


def pieces(count: int, most: int) -> list[slice]:
    """Return slices of a count, of at most so many and at least one, one after the other."""
    step = max(1, most)
    return [slice(start, start + step) for start in range(0, count, step)]


def adjoint(matrices: AnyArray) -> AnyArray:
    """Return the Hermitian transposes of matrices, shape (..., n, m)."""
    return np.conj(np.swapaxes(matrices, -1, -2))


def radius_text(value: float) -> str:
    """Return a spectral radius as text, with enough digits to differ from one, for example ``1 - 2.5e-08``."""
    distance = 1 - value
    if not 0 < abs(distance) < 1e-4:
        return f"{value:.6g}"
    return f"1 {'-' if distance > 0 else '+'} {abs(distance):.2g}"


def spectral_radius(matrices: AnyArray) -> AnyArray:
    """Return the largest eigenvalue magnitude of matrices (..., n, n), shape (...); zero of empty ones."""
    return np.abs(np.linalg.eigvals(matrices)).max(axis=-1, initial=0.0)


def qr_triangle(matrix: Array) -> Array:
    """Return the triangular factor R of a QR decomposition, batched; shape (..., min(rows, n), n)."""
    return np.asarray(np.linalg.qr(matrix, mode="r"))


def balanced_size(A: Array) -> Array:
    """Sizes of the states, powers of two, in which rows and columns of A are of alike size, shape (n,)."""
    from scipy.linalg import matrix_balance

    return matrix_balance(A, permute=False, separate=True)[1][0] if A.size else np.ones(len(A))


def entries_first(matrices: AnyArray) -> AnyArray:
    """Move the matrix axes to the front: (..., p, m) to (p, m, ...), contiguous."""
    return np.ascontiguousarray(np.moveaxis(matrices, (-2, -1), (0, 1)))


def multiply(left: AnyArray, right: AnyArray) -> AnyArray:
    """Multiply entries-first matrices: (p, r, ...) times (r, m, ...), broadcast over the rest."""
    return np.einsum("ik...,kj...->ij...", left, right)


def squared(values: AnyArray) -> AnyArray:
    """Return the squared modulus."""
    return values.real**2 + values.imag**2 if np.iscomplexobj(values) else values**2


def energy(matrices: AnyArray) -> AnyArray:
    """Return the squared Frobenius norms, shape (...), of matrices of shape (..., p, m)."""
    return squared(matrices).sum(axis=(-2, -1))


def sigma_max(matrices: ArrayLike) -> AnyArray:
    """Return the largest singular value, shape (...), of matrices of shape (..., p, m).

    Examples
    --------
    >>> from kros.uncertainty import sigma_max
    >>> sigma_max([[[3.0, 0.0], [0.0, 4.0]], [[0.0, 1.0], [0.0, 0.0]]]).tolist()
    [4.0, 1.0]
    """
    return sigma_max_first(entries_first(np.asarray(matrices)))


def sigma_max_first(matrices: AnyArray) -> AnyArray:
    """Return the largest singular value of entries-first matrices (p, m, ...), shape (...)."""
    columns = matrices if matrices.shape[1] <= matrices.shape[0] else np.swapaxes(matrices, 0, 1)
    if columns.shape[1] > 2:
        return np.linalg.norm(columns, 2, axis=(0, 1))
    first = squared(columns[:, 0]).sum(axis=0)
    if columns.shape[1] == 1:
        return np.sqrt(first)
    second = squared(columns[:, 1]).sum(axis=0)
    cross = np.einsum("i...,i...->...", np.conj(columns[:, 0]), columns[:, 1])
    return np.sqrt((first + second) / 2 + np.sqrt((first - second) ** 2 / 4 + squared(cross)))
