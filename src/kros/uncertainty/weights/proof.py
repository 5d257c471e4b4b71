r"""What a weight promises between grid points: the largest `sigma_max(W_L^-1 E_k W_R^-1)` over all frequencies.

**Level sets**: where units and nominal are systems, so is every `M_k = W_L^-1 E_k W_R^-1`, and a singular value of it
equals gamma exactly where a pencil is singular for an imaginary s. The gain is evaluated at and between its eigenvalues
until no level higher by more than the margin is met by any unit. Eigenvalues are rounded: the pencil is tried first at
a level below the peak, where the grid has all crossings, and when it misses one the proof is refused. **Grid**:
responses alone and refused proofs have the peaks of a dense grid, which proves nothing between its
points.

Residuals, what forms leave out, and their ratios to weights are descriptor systems, `s F x = A x + B u, y = C x + D u`
with `s = (z - 1) / (z + 1)`. Sums, products and inverses of descriptors are descriptors, and so is a pseudo-inverse,
with P~ the adjoint system: for a tall P, `x = P^+ d` is `P~ (d - P x) = 0`, and for a wide one it is transposed.

References
----------
N. A. Bruinsma and M. Steinbuch, "A fast algorithm to compute the H-infinity norm of a transfer function matrix",
Systems & Control Letters 14 (1990) 287-293.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from enum import Enum

import numpy as np

from ...core import AnyArray, StateSpace, frozen
from ...core.frequency import nyquist_hz
from ...core.norms import sharpened, to_continuous
from ..forms import Form, change_of, loop_of, residual_of
from ..settings import PROOF

Ratio = Callable[[AnyArray], AnyArray]


class ProofMethod(str, Enum):
    """How the bound between grid points is known."""

    GRID = "grid"
    LEVEL_SETS = "level sets"


@dataclass(frozen=True)
class Certificate:
    """Largest ratio over all frequencies, attained at `freq_hz`."""

    method: ProofMethod
    peak: float
    freq_hz: float

    @property
    def bound(self) -> float:
        """What no ratio exceeds, by level sets; on a grid the same above the largest one that was evaluated."""
        return self.peak * (1 + PROOF.margin)


def certify(ratio: Ratio, freqs_hz: AnyArray, known: AnyArray, pencils: list[Descriptor], dt: float) -> Certificate:
    """Return the largest ratio (unit, n) from DC to Nyquist, from a dense grid, Hz, by level sets if possible."""
    freq, peak = sharpened(ratio, freqs_hz, known.max(axis=0))
    provable = pencils and peak > 0 and _trusted(pencils, freqs_hz, known, dt)
    for _ in range(PROOF.levels if provable else 0):
        points = np.unique(np.concatenate([_candidates(p, peak * (1 + PROOF.margin), dt) for p in pencils]))
        values = ratio(points).max(axis=0)
        top = int(values.argmax())
        if values[top] <= peak * (1 + PROOF.margin):
            return Certificate(ProofMethod.LEVEL_SETS, peak, freq)
        peak, freq = float(values[top]), float(points[top])
    return Certificate(ProofMethod.GRID, peak, freq)


def _crossings_hz(pencil: Descriptor, gamma: float, dt: float) -> AnyArray:
    """Return the frequencies, Hz, at which a singular value may equal gamma."""
    s = pencil.crossings(gamma)
    near = s[(np.abs(s.real) <= PROOF.near * np.abs(s)) & (s.imag > 0)].imag
    return np.unique(np.arctan(near) / (np.pi * dt))


def _candidates(pencil: Descriptor, gamma: float, dt: float) -> AnyArray:
    """Return the crossings of a level and points between them."""
    points = _crossings_hz(pencil, gamma, dt)
    ends = np.concatenate([[0.0], points, [nyquist_hz(dt)]])
    return np.concatenate([ends, (ends[1:] + ends[:-1]) / 2, np.sqrt(points[1:] * points[:-1])])


def _trusted(pencils: list[Descriptor], freqs_hz: AnyArray, known: AnyArray, dt: float) -> bool:
    """Tell whether the pencil of the worst unit has an eigenvalue at every crossing that the grid shows."""
    unit = int(known.max(axis=1).argmax())
    level = PROOF.probe * float(known[unit].max())
    above = known[unit] > level
    crossing = np.flatnonzero(above[1:] != above[:-1])
    at = _crossings_hz(pencils[unit], level, dt)
    low, high = freqs_hz[crossing] * (1 - PROOF.near), freqs_hz[crossing + 1] * (1 + PROOF.near)
    seen = np.searchsorted(at, high, side="right") > np.searchsorted(at, low)
    return bool(seen.all())


@frozen
class Descriptor:
    """`s F x = A x + B u, y = C x + D u`."""

    F: AnyArray
    A: AnyArray
    B: AnyArray
    C: AnyArray
    D: AnyArray

    @classmethod
    def of(cls, system: StateSpace) -> Descriptor:
        """Return a discrete system."""
        mapped = to_continuous(system)
        return cls(np.eye(mapped.n_states), *mapped.matrices)

    def __matmul__(self, first: Descriptor) -> Descriptor:
        """Return the series connection, the other one first."""
        A = np.block([[first.A, np.zeros((len(first.A), len(self.A)))], [self.B @ first.C, self.A]])
        B, C = np.vstack([first.B, self.B @ first.D]), np.hstack([self.D @ first.C, self.C])
        return Descriptor(_diagonal(first.F, self.F), A, B, C, self.D @ first.D)

    def __sub__(self, other: Descriptor) -> Descriptor:
        """Return the difference of two systems with the same input."""
        F, A = _diagonal(self.F, other.F), _diagonal(self.A, other.A)
        return Descriptor(F, A, np.vstack([self.B, other.B]), np.hstack([self.C, -other.C]), self.D - other.D)

    @property
    def transposed(self) -> Descriptor:
        """The system with the transposed response."""
        return Descriptor(self.F.T, self.A.T, self.C.T, self.B.T, self.D.T)

    def inverse(self) -> Descriptor:
        """Return the inverse of a square system: its input is one more unknown, `C x + D u = y`."""
        n, m = self.B.shape
        A = np.block([[self.A, self.B], [self.C, self.D]])
        B, C = np.vstack([np.zeros((n, m)), -np.eye(m)]), np.hstack([np.zeros((m, n)), np.eye(m)])
        return Descriptor(_diagonal(self.F, np.zeros((m, m))), A, B, C, np.zeros((m, m)))

    def pseudo_inverse(self) -> Descriptor:
        """Return the least-squares or least-norm inverse of a system with F = 1, by its adjoint system."""
        n, (p, m) = len(self.A), self.D.shape
        if p < m:
            return self.transposed.pseudo_inverse().transposed
        B = np.vstack([np.zeros((n, p)), -self.C.T, self.D.T])  # of unknowns: states, adjoint states, x
        C = np.hstack([np.zeros((m, 2 * n)), np.eye(m)])
        F = np.diag(np.repeat([1.0, 0.0], [2 * n, m]))
        return Descriptor(F, self._with_adjoint(1.0), B, C, np.zeros((m, p)))

    def _with_adjoint(self, sign: float) -> AnyArray:
        """Return the matrix of states, adjoint states and input of the system followed by its adjoint."""
        C, D = self.C, self.D
        below = [[sign * C.T @ C, -self.A.T, sign * C.T @ D], [-sign * D.T @ C, self.B.T, -sign * D.T @ D]]
        return np.block([[self.A, np.zeros_like(self.A), self.B], *below])

    def crossings(self, gamma: float) -> AnyArray:
        r"""Return the s at which a singular value may equal gamma.

        They are the finite eigenvalues of

        [ A - s F     0                B                ]
        [ -C^T C      -A^T - s F^T     -C^T D           ]
        [ D^T C       B^T              D^T D - gamma^2  ]
        """
        n, m = self.B.shape
        level = np.diag(np.repeat([0.0, gamma**2], [2 * n, m]))
        return _eigenvalues(self._with_adjoint(-1.0) - level, _diagonal(self.F, self.F.T, np.zeros((m, m))))

    def poles(self) -> AnyArray:
        """Return the finite eigenvalues of the pencil."""
        return _eigenvalues(self.A, self.F)


def _diagonal(*blocks: AnyArray) -> AnyArray:
    from scipy.linalg import block_diag

    return np.asarray(block_diag(*blocks), float)


def _eigenvalues(left: AnyArray, right: AnyArray) -> AnyArray:
    """Return the finite eigenvalues of a pencil whose rows and columns are brought to sizes near one."""
    from scipy.linalg import eigvals

    if not len(left):
        return np.zeros(0)
    for axis in (0, 1) * 6:
        size = np.maximum(np.abs(left).max(axis=axis, keepdims=True), np.abs(right).max(axis=axis, keepdims=True))
        scale = 2.0 ** -np.round(np.log2(np.where(size > 0, size, 1.0)) / 2)
        left, right = left * scale, right * scale
    with np.errstate(all="ignore"):
        values = eigvals(left, right)
    return values[np.isfinite(values)]


def leaves_nothing(form: Form, n_outputs: int, n_inputs: int) -> bool:
    """Tell whether a form rebuilds every regular unit of a shape exactly."""
    return (not form.at_input or n_outputs <= n_inputs) and (form.sees_input or n_outputs >= n_inputs)


def residual_system(form: Form, G: Descriptor, Gp: Descriptor, remainder: bool) -> Descriptor:
    """Return the residual, or the remainder of a form: the unit minus what `forms.rebuild` makes of the residual."""
    E = residual_of(form, G, Gp, Descriptor.pseudo_inverse)
    if not remainder:
        return E
    if not form.inverse:
        return (Gp - G) - change_of(form, G, E)
    loop = loop_of(form, G, E)
    inverse = replace(loop, C=-loop.C, D=np.eye(len(loop.D)) - loop.D).inverse()
    return Gp - (G @ inverse if form.at_input else inverse @ G)


def invert(system: StateSpace) -> StateSpace:
    """Return the inverse of a square system with a regular feedthrough."""
    D = np.linalg.inv(system.D)
    B = system.B @ D
    return StateSpace(system.A - B @ system.C, B, -D @ system.C, D, system.dt)
