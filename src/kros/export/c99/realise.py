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
_ALIKE = 1e4  # condition of the modes, by which rounding grows
_SMALLER = 0.1  # of a column, where a difference is worth a subtraction
_PLAIN = 0.01  # factors as near to one are one: that difference is exact


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
        first, own = len(observer.recorded), turned.A.copy()
        measured = list(observer.measured)
        A = turn @ A @ np.linalg.inv(turn)  # leaves the measured columns apart from the others
        block = np.abs(own[first:n, first:n])
        own[first:n, first:n][block < 1e-12 * block.max()] = 0.0
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
            factor = 1.0 if abs(factor - 1) < _PLAIN else factor
            left[j] = float(np.linalg.norm(column + factor * along)), factor
        best = min(left, key=left.__getitem__, default=None)
        if best is not None and left[best][0] < _SMALLER * np.linalg.norm(column):
            found.append((best, i, left[best][1]))
            free.remove(best)
    return tuple(found)


def to_modes(observer: Observer) -> Array | None:
    """Return coordinates of the modes of a bank's filters, (n_lifted, n_lifted); None without a bank."""
    if observer.bank is None:
        return None
    n, first, last = observer.lifting.n_states, len(observer.recorded), len(observer.recorded) + observer.bank.filters
    turn = np.eye(observer.lifting.n_lifted)
    for begin, end in ((first, last), (last, n - first)):
        turn[begin:end, begin:end] = _modes(observer.A[begin:end, begin:end])
    return turn


def _modes(A: Array) -> Array:
    """Return the coordinates of the modes of a matrix; the identity where their vectors are nearly alike."""
    values, vectors = np.linalg.eig(A)
    columns = [
        part
        for i, v in enumerate(values)
        if v.imag >= 0
        for part in ([vectors[:, i].real, vectors[:, i].imag] if v.imag else [vectors[:, i].real])
    ]
    basis = np.array(columns).T
    if basis.shape != A.shape or not A.size or np.linalg.cond(basis) > _ALIKE:
        return np.eye(len(A))
    return np.asarray(np.linalg.inv(basis))


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
