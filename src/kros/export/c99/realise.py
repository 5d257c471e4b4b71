r"""The linear part of an observer as numbers that rounding does little to, and with few operations.

Internal states are in the coordinates of their modes, a real block diagonal form: two multiplications each in place of
one for every other state.

An observer that watches the difference of a reference and a measurement has large columns of either that cancel: what
is left is a millionth of either, and rounding is not. So the difference is formed first. For the input j and the
measured state i with :math:`B_j \approx -c\,(A - I)_i`

.. math:: (A - I)_i\, x_i + B_j u_j = \bigl((A - I)_i + c\, B_j\bigr) x_i + B_j\, (u_j - c\, x_i),

of which the first column is small; it is formed before coordinates change.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

from ...observer import Observer

Array = npt.NDArray[np.float64]


@dataclass(frozen=True)
class ExportRule:
    """How an observer is realised in C, and how the origin of single precision moves; estimates stay the same."""

    alike: float = 1e4  # condition of the modes, by which rounding grows, up to which they are used
    smaller: float = 0.1  # of a column: what is left of it where a difference is worth a subtraction
    plain: float = 0.01  # factors as near to a whole number are whole: their difference is exact
    negligible: float = 1e-12  # of the largest entry of a block of modes: rounding
    far: int = 8  # periods from the origin, as far as single precision goes
    rounding: float = 5e4 * np.finfo(float).eps  # of the largest term of a direction
    periods: int = 64  # of the first function at most, until all others repeat
    static: float = 0.01  # of the largest measurement: the step of the origin where no function repeats


RULE = ExportRule()


@dataclass(frozen=True, eq=False)
class Realised:
    """An observer as it is computed."""

    observer: Observer
    model: Array  # (n, n_lifted + m)
    less: tuple[tuple[int, int, float], ...]
    start: Array  # (n, n_lifted + m), of a filter bank
    into: Array  # (filters, q), from measurements to the filters of a bank

    @classmethod
    def of(cls, observer: Observer) -> Realised:
        """Realise an observer."""
        n, less, A = observer.lifting.n_states, differences(observer), observer.A.copy()
        start = np.zeros((n, 0)) if observer.bank is None else observer.bank.start.copy()
        for j, i, factor in less:
            A[:, i] += factor * observer.B[:, j]
            if observer.bank is not None:
                start[:, i] += factor * start[:, len(A) + j]
        turn = to_modes(observer)
        if turn is None:
            return cls(observer, np.hstack([A[:n], observer.B[:n]]), less, start, _into(observer))
        turned = in_coordinates(observer, turn)
        own, measured = turned.A.copy(), list(observer.measured)
        A = turn @ A @ np.linalg.inv(turn)  # leaves the measured columns apart from the others
        for part in _parts(observer):
            block = own[part, part]
            if np.count_nonzero(turn[part, part]) > len(block):  # of modes, others have no rounding
                block[np.abs(block) < RULE.negligible * np.abs(block).max()] = 0.0
        model = np.hstack([own[:n], turned.B[:n]])
        model[:, measured] = A[:n, measured]
        turned = replace(turned, A=own)
        return cls(turned, model, less, turn[:n, :n] @ start, _into(turned))


def _into(observer: Observer) -> Array:
    """Return the gains from measurements to the filters of a bank."""
    if observer.bank is None:
        return np.zeros((0, len(observer.measured)))
    first = len(observer.recorded)
    return observer.A[first : first + observer.bank.filters][:, list(observer.measured)]


def differences(observer: Observer) -> tuple[tuple[int, int, float], ...]:
    """Return which input is better taken relative to which measured state, and the factor of the state."""
    n, found, free = observer.lifting.n_states, [], set(range(len(observer.inputs)))
    for i in observer.measured:
        column = observer.A[:n, i] - np.eye(n)[i]
        left = {}
        for j in free:
            along = observer.B[:n, j]
            factor = -float(along @ column) / max(float(along @ along), 1e-300)
            factor = 1.0 if abs(factor - 1) < RULE.plain else factor
            left[j] = float(np.linalg.norm(column + factor * along)), factor
        best = min(left, key=left.__getitem__, default=None)
        if best is not None and left[best][0] < RULE.smaller * np.linalg.norm(column):
            found.append((best, i, left[best][1]))
            free.remove(best)
    return tuple(found)


def to_modes(observer: Observer) -> Array | None:
    """Return coordinates of the modes of a bank's filters, (n_lifted, n_lifted); None without a bank."""
    if observer.bank is None:
        return None
    from scipy.linalg import matrix_balance

    n, turn = observer.lifting.n_states, np.eye(observer.lifting.n_lifted)
    _, (scale, _) = matrix_balance(observer.A[:n, :n], permute=False, separate=True)
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
    return np.asarray(np.linalg.inv(basis) / scale)


def in_coordinates(observer: Observer, turn: Array) -> Observer:
    """The observer in coordinates ``turn @ theta`` that leave recorded states and functions alone."""
    n = observer.lifting.n_states
    bank, guard = observer.bank, observer.guard
    return replace(
        observer,
        A=turn @ observer.A @ np.linalg.inv(turn),
        B=turn @ observer.B,
        bank=None if bank is None else bank.turned(turn[:n, :n]),
        guard=None if guard is None else guard.turned(turn[:n, :n]),
    )
