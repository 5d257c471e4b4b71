"""Linear time-invariant systems in state space, alone or in batches.

A batch has leading axes, the unit axis first; all systems of a batch share sizes and the sampling period.

Symbols
-------
A, B, C, D : state-space matrices, x+ = A x + B u, y = C x + D u (dt > 0) or dx/dt = A x + B u (dt = 0)
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from .arrays import AnyArray, ArrayLike, frozen
from .errors import DimensionError
from .linalg import spectral_radius


def real_array(name: str, values: Any) -> AnyArray:
    """Return a matrix of doubles, or say by name what else was found."""
    try:
        if np.iscomplexobj(values):
            raise ValueError("complex numbers; take the real part if that is meant")
        return np.asarray(values, dtype=float)
    except (TypeError, ValueError) as error:
        raise DimensionError(f"{name} should be a real matrix, found {type(values).__name__}: {error}.") from error


def sampling_period(name: str, dt: Any) -> float:
    """Return the sampling period in seconds, or say by name what else was found."""
    if not isinstance(dt, int | float | np.number) or not 0 <= dt < np.inf:
        raise DimensionError(f"{name}: the sampling period should be seconds, 0 for continuous time; found {dt!r}.")
    return float(dt)


@frozen
class StateSpace:
    """State-space system, or a batch of them.

    Parameters
    ----------
    A : ndarray, shape (..., n, n)
    B : ndarray, shape (..., n, m)
    C : ndarray, shape (..., p, n)
    D : ndarray, shape (..., p, m)
    dt : float, s
        Sampling period; 0 means continuous time.

    Raises
    ------
    DimensionError
        When the shapes do not fit together or `dt` is negative.

    Examples
    --------
    >>> lag = StateSpace([[0.5]], [[0.5]], [[1.0]], [[0.0]], 0.01)
    >>> abs(lag.frequency_response([0.0])).item()
    1.0
    """

    A: AnyArray
    B: AnyArray
    C: AnyArray
    D: AnyArray
    dt: float

    def __post_init__(self) -> None:
        for name in "ABCD":
            object.__setattr__(self, name, real_array(f"State space: {name}", getattr(self, name)))
        object.__setattr__(self, "dt", sampling_period("State space", self.dt))
        n, m, p = self.A.shape[-1], self.B.shape[-1], self.C.shape[-2]
        shapes = {name: getattr(self, name).shape for name in "ABCD"}
        for name, shape in {"A": (n, n), "B": (n, m), "C": (p, n), "D": (p, m)}.items():
            if shapes[name][-2:] != shape:
                raise DimensionError(f"State space: {name} should end in shape {shape}, found {shapes}; correct it.")

    @classmethod
    def of(cls, system: Any) -> StateSpace:
        """Return any object with `A, B, C, D, dt` as a `StateSpace`; a period of None means continuous time."""
        if isinstance(system, cls):
            return system
        try:
            return cls(system.A, system.B, system.C, system.D, 0.0 if system.dt is None else system.dt)
        except AttributeError as error:
            problem = f"needs a system with A, B, C, D and dt, found {type(system).__name__} ({error})"
            raise DimensionError(f"State space: {problem}; convert it first.") from error

    @property
    def matrices(self) -> tuple[AnyArray, ...]:
        """A, B, C and D."""
        return self.A, self.B, self.C, self.D

    @property
    def n_states(self) -> int:
        """Number of states."""
        return self.A.shape[-1]

    @property
    def n_inputs(self) -> int:
        """Number of inputs."""
        return self.B.shape[-1]

    @property
    def n_outputs(self) -> int:
        """Number of outputs."""
        return self.C.shape[-2]

    @property
    def batch_shape(self) -> tuple[int, ...]:
        """Leading axes shared by the four matrices."""
        return np.broadcast_shapes(*(matrix.shape[:-2] for matrix in self.matrices))

    def __getitem__(self, index: Any) -> StateSpace:
        """Return one system, or a smaller batch, of a batch."""
        shape = self.batch_shape
        A, B, C, D = (np.broadcast_to(matrix, shape + matrix.shape[-2:])[index] for matrix in self.matrices)
        return StateSpace(A, B, C, D, self.dt)

    def poles(self) -> AnyArray:
        """Return the eigenvalues of A, shape (..., n)."""
        return np.linalg.eigvals(self.A)

    def spectral_radius(self) -> AnyArray:
        """Return the largest pole magnitude, shape (...); zero without states."""
        return spectral_radius(self.A)

    def largest_pole(self) -> float:
        """Return the spectral radius, or the largest real part of a pole in continuous time, of one system."""
        return float(self.spectral_radius() if self.dt > 0 else self.poles().real.max(initial=-np.inf))

    def is_finite(self) -> bool:
        """Tell whether no matrix contains NaN or infinity."""
        return all(np.isfinite(matrix).all() for matrix in self.matrices)

    def multiplied(self, outputs: AnyArray, inputs: AnyArray) -> StateSpace:
        """Return the system with its outputs (p,) and inputs (m,) multiplied."""
        C, D = outputs[:, None] * self.C, outputs[:, None] * self.D * inputs
        return StateSpace(self.A, self.B * inputs, C, D, self.dt)

    def is_stable(self) -> AnyArray:
        """Tell whether every pole is inside the unit circle (or the left half-plane)."""
        poles = self.poles()
        return np.all(np.abs(poles) < 1 if self.dt > 0 else poles.real < 0, axis=-1)

    def frequency_response(self, freqs_hz: ArrayLike) -> AnyArray:
        """Return the transfer matrix on the unit circle (or imaginary axis), shape (..., n_freqs, p, m), complex."""
        s = 2j * np.pi * np.asarray(freqs_hz, dtype=float)
        # zeta = z - 1 keeps full relative precision at low frequency, where z and A are both close to one.
        zeta = np.expm1(s * self.dt) if self.dt > 0 else s
        eye = np.eye(self.n_states)
        shifted = self.A - eye if self.dt > 0 else self.A
        resolvent = zeta[:, None, None] * eye - shifted[..., None, :, :]
        B = np.broadcast_to(self.B[..., None, :, :] + 0j, (*resolvent.shape[:-1], self.n_inputs))
        return self.C[..., None, :, :] @ np.linalg.solve(resolvent, B) + self.D[..., None, :, :]

    def __matmul__(self, other: StateSpace) -> StateSpace:
        """Series connection `self * other`: the input passes through `other` first."""
        if self.n_inputs != other.n_outputs or self.dt != other.dt:
            sizes = f"{self.n_inputs} inputs at {self.dt} s against {other.n_outputs} outputs at {other.dt} s"
            raise DimensionError(f"Series connection: {sizes}; match them.")
        zero = np.zeros((other.n_states, self.n_states))
        A = np.block([[self.A, self.B @ other.C], [zero, other.A]])
        B, C = np.block([[self.B @ other.D], [other.B]]), np.block([[self.C, self.D @ other.C]])
        return StateSpace(A, B, C, self.D @ other.D, self.dt)


def gain(matrix: ArrayLike, dt: float) -> StateSpace:
    """Return a static gain as a system without states.

    Examples
    --------
    >>> from kros.core import gain, hinf_norm
    >>> hinf_norm(gain([[3.0, 4.0]], 0.01))
    5.0
    """
    D = np.atleast_2d(np.asarray(matrix, dtype=float))
    return StateSpace(np.zeros((0, 0)), np.zeros((0, D.shape[1])), np.zeros((len(D), 0)), D, dt)


def block_diagonal(systems: Sequence[StateSpace]) -> StateSpace:
    """Stack systems side by side: inputs and outputs are concatenated.

    Examples
    --------
    >>> from kros.core import block_diagonal, gain
    >>> block_diagonal([gain([[2.0]], 0.01), gain([[3.0]], 0.01)]).D.tolist()
    [[2.0, 0.0], [0.0, 3.0]]
    """
    from scipy.linalg import block_diag

    if not systems or len({s.dt for s in systems}) > 1:
        periods = [s.dt for s in systems]
        raise DimensionError(f"Block diagonal: needs one sampling period, found {periods} s; resample first.")

    A, B, C, D = map(block_diag, *(s.matrices for s in systems))
    return StateSpace(A, B, C, D, systems[0].dt)
