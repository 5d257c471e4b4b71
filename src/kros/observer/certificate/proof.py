r"""Proof of a gain, independent of whatever solver proposed it.

With a Lyapunov matrix ``P = R' R`` the gain gamma is proven when

    F = [[P, 0], [0, gamma^2 I]] - [A_c, B_c]' P [A_c, B_c] - [C, D]' [C, D] > 0

for every corner c. What is subtracted is convex in the slopes, so corners are enough. (D is zero but where multipliers
stand in for corners: then p is an input and q an output.)

The decision is exact: matrices of doubles are rational, so F is formed without rounding, and its positivity decided by
a Cholesky factorisation in floating point of what is left without all that rounding can do; where that is not enough,
by elimination of integers.

References
----------
S. M. Rump, "Verification of positive definiteness", BIT Numerical Mathematics 46 (2006) 433-452.
E. H. Bareiss, "Sylvester's identity and multistep integer-preserving Gaussian elimination", Mathematics of Computation
22 (1968) 565-578.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

Array = npt.NDArray[np.float64]
Integers = npt.NDArray[Any]
Corners = Sequence[tuple[Array, Array]]
_BITS = 96  # of the scaled matrix that is decided on; the rounding to them is subtracted
_ROUNDING = 8.0  # times what a factorisation may be off, with a factor of five to spare


def proven(root: Array, corners: Corners, C: Array, gain: float, D: Array | None = None) -> bool:
    """Tell whether the inequalities hold, in exact arithmetic on the numbers as they are stored."""
    numbers = [root, C, np.array(gain), *(matrix for corner in corners for matrix in corner)]
    if not all(np.isfinite(part).all() for part in numbers):
        return False
    D = np.zeros((len(C), corners[0][1].shape[1])) if D is None else D
    out, level = _gram(_Exact.of(np.hstack([C, D]))), _gram(_Exact.of(np.array([[gain]])))
    held = _gram(_Exact.of(root))
    for A, B in corners:
        n, width = A.shape[1], B.shape[1]
        moved = _gram(_Exact.of(root) @ _Exact.of(np.hstack([A, B])))
        shift = max(part.shift for part in (moved, held, out, level))
        F = -moved.at(shift) - out.at(shift)
        F[:n, :n] += held.at(shift)
        F[range(n, n + width), range(n, n + width)] += level.at(shift)[0, 0]
        if not _positive(F):
            return False
    return True


@dataclass(frozen=True, eq=False)
class _Exact:
    """A matrix of integers over a power of two."""

    integers: Integers
    shift: int

    @classmethod
    def of(cls, matrix: Array) -> _Exact:
        mantissa, exponent = np.frexp(np.asarray(matrix, dtype=float))
        whole, power = (mantissa * 2.0**53).astype(np.int64), exponent.astype(int) - 53
        lowest = int(power[whole != 0].min()) if whole.any() else 0
        integers = np.empty(matrix.shape, dtype=object)
        for place in np.ndindex(*matrix.shape):
            integers[place] = int(whole[place]) << int(power[place] - lowest) if whole[place] else 0
        return cls(integers, -lowest)

    def __matmul__(self, other: _Exact) -> _Exact:
        return _Exact(self.integers @ other.integers, self.shift + other.shift)

    def at(self, shift: int) -> Integers:
        return np.asarray(self.integers * (1 << (shift - self.shift)), dtype=object)


def _gram(matrix: _Exact) -> _Exact:
    return _Exact(matrix.integers.T @ matrix.integers, 2 * matrix.shift)


def _positive(F: Integers) -> bool:
    """Tell whether a symmetric matrix of integers is positive definite."""
    n = len(F)
    if any(F[i, i] <= 0 for i in range(n)):
        return False
    half = [-(int(F[i, i]).bit_length() // 2) for i in range(n)]
    M = np.empty((n, n), dtype=object)
    for i, j in np.ndindex(n, n):
        power = half[i] + half[j] + _BITS
        M[i, j] = int(F[i, j]) << power if power >= 0 else int(F[i, j]) >> -power
    M[range(n), range(n)] -= n
    return _clearly_positive(M) or _eliminated(M)


def _clearly_positive(M: Integers) -> bool:
    """Tell whether a matrix of integers is positive definite by more than rounding."""
    try:
        rounded = M.astype(float) * 2.0**-_BITS
        spare = _ROUNDING * (len(M) + 4) * np.finfo(float).eps * float(np.trace(rounded))
        np.linalg.cholesky(rounded - spare * np.eye(len(M)))
    except (np.linalg.LinAlgError, OverflowError):  # entries beyond any float are beyond the diagonal
        return False
    return True


def _eliminated(M: Integers) -> bool:
    """Tell whether a matrix of integers is positive definite, by elimination without rounding."""
    n, pivot = len(M), 1
    for k in range(n):
        if M[k, k] <= 0:
            return False
        M[k + 1 :, k + 1 :] = (M[k, k] * M[k + 1 :, k + 1 :] - np.outer(M[k + 1 :, k], M[k, k + 1 :])) // pivot
        pivot = M[k, k]
    return True
