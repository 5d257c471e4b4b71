r"""The upper bound of the structured singular value between the points of a grid, by level sets.

Scalings that are good at one frequency bound mu at all others as well: ``mu <= sigma_max(X_L^{1/2} M X_R^{-1/2})`` with X_L and X_R held. The
frequencies at which this equals a level are imaginary eigenvalues of a Hamiltonian matrix, so that one eigenvalue problem tells over which range around
its point the held scaling proves the level:

    0 ----[===== point 1 =====]------------------------------ Nyquist
                        [= point 2 =]
                               [============ point 3 ========] ...

Ranges are joined from the lowest frequency to the highest. Where two of them do not meet, scalings are computed in the gap; where the bound is higher
there, a peak was missed, and the level is raised to it.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from ...core.lti import StateSpace
from ...core.norms import hinf_norm, to_continuous
from .blocks import Structure
from .scalings import scalings

Array = npt.NDArray[Any]

_SLACK = (1e-2, 3e-2, 0.1, 0.3, 1.0, 3.0)  # over the peak; the next where the eigenvalue problems of one do not suffice
_PROBLEMS = 150
_NEAR = 1e-3


@dataclass(frozen=True, eq=False)
class Everywhere:
    """A bound at every frequency, and the points that were added: frequencies, upper bounds."""

    bound: float
    freqs_hz: Array
    upper: Array


def everywhere(system: StateSpace, structure: Structure, freqs_hz: Array, upper: Array) -> Everywhere:
    """Return a bound of mu at every frequency, from zero to Nyquist or infinity.

    Parameters
    ----------
    system : StateSpace
        Stable, from w to z.
    structure : Structure
    freqs_hz, upper : ndarray, shape (f,)
        Grid and the bounds on it.
    """
    norm = hinf_norm(system) * (1 + 2e-6)
    if not system.n_states or upper.max(initial=0.0) >= norm / (1 + _SLACK[0]):
        return Everywhere(norm, np.zeros(0), np.zeros(0))
    search = _Sweep(system, to_continuous(system) if system.dt > 0 else system, structure, dict(zip(freqs_hz, upper, strict=True)))
    start = 0.0
    for slack in _SLACK:
        level, start = search.covered(slack, start, norm)
        if start == np.inf:
            break
    new = np.array([f for f in search.points if f not in set(freqs_hz)])
    return Everywhere(min(level, norm) if start == np.inf else norm, new, np.array([search.points[f] for f in new]))


@dataclass(frozen=True, eq=False)
class _Sweep:
    """The system as it is and in continuous time, and the points so far: frequency in Hz to bound."""

    system: StateSpace
    continuous: StateSpace
    structure: Structure
    points: dict[float, float]

    def covered(self, slack: float, start: float, norm: float) -> tuple[float, float]:
        """Return a level, and the mapped frequency up to which it is proven: infinity when it holds everywhere."""
        done, trial = start, None
        for _ in range(_PROBLEMS):
            level = max(self.points.values()) * (1 + slack)
            if level >= norm:
                return norm, np.inf
            grid = np.array(sorted(self._mapped(f) for f in self.points))
            nu = trial if trial is not None else float(grid[np.searchsorted(grid, done)] if done <= grid[-1] else 2 * done)
            low, high = self._range(nu, level)
            if low <= done < high:
                done, trial = high * (1 + 1e-12), None
                if done == np.inf:
                    return level, done
            elif nu <= done * (1 + 1e-9) or (high <= done):
                return level, done
            else:
                trial = done + (min(low, nu) - done) / 2 if trial is not None or low > done else None
                if trial is not None and trial - done <= 1e-11 * max(trial, 1e-300):
                    return level, done
        return level, done

    def _range(self, nu: float, level: float) -> tuple[float, float]:
        """Range around a mapped frequency in which the scaling of that frequency proves the level; empty, (nu, nu), where it does not."""
        freq = self._freq(nu)
        found = scalings(self.system.frequency_response(np.array([freq])), self.structure)
        self.points[float(freq)] = float(found.upper[0])
        if found.upper[0] > level:
            return nu, nu
        left = np.conj(np.linalg.cholesky(found.X_L[0])).T
        right = np.conj(np.linalg.inv(np.linalg.cholesky(found.X_R[0]))).T
        marks = _crossings(self.continuous, left, right, level)
        if marks is None:
            return nu, nu
        marks = np.unique(np.concatenate([[0.0], marks]))
        inner = np.concatenate([(marks[1:] + marks[:-1]) / 2, [2 * marks[-1] + 1.0]])
        nus = np.concatenate([inner, marks])
        response = left @ self.system.frequency_response(np.array([self._freq(x) for x in nus])) @ right
        below = np.linalg.norm(response, 2, axis=(-2, -1)) <= level
        between, at = below[: len(inner)], below[len(inner) :]
        k = int(np.searchsorted(marks, nu, side="right")) - 1
        if not between[k]:
            return nu, nu
        first = last = k
        while first > 0 and at[first] and between[first - 1]:
            first -= 1
        while last < len(marks) - 1 and at[last + 1] and between[last + 1]:
            last += 1
        return float(marks[first]), float(marks[last + 1]) if last < len(marks) - 1 else np.inf

    def _mapped(self, freq_hz: float) -> float:
        dt = self.system.dt
        if dt == 0:
            return float(2 * np.pi * freq_hz)
        return float(np.tan(np.pi * min(freq_hz * dt, 0.5 - 1e-12)))

    def _freq(self, nu: float) -> float:
        dt = self.system.dt
        return float(np.arctan(nu) / (np.pi * dt)) if dt > 0 else float(nu / (2 * np.pi))


def _crossings(system: StateSpace, left: Array, right: Array, level: float) -> Array | None:
    """Positive frequencies at which the scaled gain may equal the level; None where it exceeds it at infinity."""
    A, B, C, D = system.A, system.B @ right, left @ system.C, left @ system.D @ right
    R = level**2 * np.eye(D.shape[1]) - np.conj(D).T @ D
    if np.linalg.eigvalsh(R)[0] <= 0:
        return None
    F = np.linalg.solve(R, np.hstack([np.conj(D).T @ C, np.conj(B).T]))
    n = len(A)
    closed = A + B @ F[:, :n]
    Q = np.conj(C).T @ C + np.conj(C).T @ D @ F[:, :n]
    H = np.block([[closed, level * (B @ F[:, n:])], [-Q / level, -np.conj(closed).T]])
    values = np.linalg.eigvals(H)
    # Nearly imaginary ones count too: what is superfluous only splits a range.
    near = values[(np.abs(values.real) <= _NEAR * np.abs(values)) & (values.imag > 0)]
    return np.asarray(near.imag)
