"""The linear part of an observer with few operations: filters in the coordinates of their modes.

Internal states are in a real block diagonal form: two multiplications each in place of one for every other state.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from ...core import ROUNDING, Array, frozen
from ...core.linalg import balanced_size
from ...observer import Observer
from ...observer.units import in_coordinates


@frozen
class ExportRule:
    """How an observer is realised in C, and how the origin of single precision moves; estimates stay the same."""

    alike: float = 1e4  # condition of the modes, by which rounding grows, up to which they are used
    whole: float = 0.01  # factors as near to a whole number are whole: their difference is exact
    far: int = 8  # periods from the origin, as far as single precision goes
    rounding: float = 5e4 * np.finfo(float).eps  # of the largest term of a direction
    periods: int = 60  # of the first function at most, until all others repeat
    static: float = 0.01  # of the largest measurement: the step of the origin where no function repeats


RULE = ExportRule()


def realised(observer: Observer) -> Observer:
    """Return an observer as it is computed; what is rounding among the modes of a bank's filters is left out."""
    if observer.bank is None:
        return observer
    turn = to_modes(observer)
    turned = in_coordinates(observer, turn)
    A = turned.A.copy()
    for part in _parts(observer):
        block = A[part, part]
        if np.count_nonzero(turn[part, part]) > len(block):  # of modes, others have no rounding
            block[np.abs(block) < ROUNDING * np.abs(block).max()] = 0.0
    return replace(turned, A=A)


def to_modes(observer: Observer) -> Array:
    """Return coordinates of the modes of a bank's filters, (n_lifted, n_lifted)."""
    n, turn = observer.lifting.n_states, np.eye(observer.lifting.n_lifted)
    scale = balanced_size(observer.A[:n, :n])
    for part in _parts(observer):
        turn[part, part] = _modes(observer.A[part, part], scale[part])
    return turn


def _parts(observer: Observer) -> tuple[slice, slice]:
    """Return the filters of a bank, and those of inputs alone."""
    assert observer.bank is not None
    n, first, last = observer.lifting.n_states, len(observer.recorded), len(observer.recorded) + observer.bank.filters
    return slice(first, last), slice(last, n - first)


def _modes(A: Array, scale: Array) -> Array:
    """Return the coordinates of the modes of a matrix, or states over their scale where vectors are nearly alike."""
    A = A / scale[:, None] * scale
    values, vectors = np.linalg.eig(A)
    upper = [i for i, v in enumerate(values) if v.imag >= 0]
    parts = [[vectors[:, i].real, vectors[:, i].imag][: 1 + bool(values[i].imag)] for i in upper]
    basis = np.array([part for pair in parts for part in pair]).T
    if basis.shape != A.shape or not A.size or np.linalg.cond(basis) > RULE.alike:
        return np.diag(1 / scale)
    return np.linalg.inv(basis) / scale
