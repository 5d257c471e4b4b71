r"""What a weight promises between grid points: the largest `sigma_max(W_L^-1 E_k W_R^-1)` over all frequencies.

Two methods. **Grid**: residuals known at frequencies only are asked again around every high local maximum, in three rounds, each twenty times
finer. It finds what the grid shows signs of, and proves nothing. **Level sets**: where units and nominal are systems, so is every
`M_k = W_L^-1 E_k W_R^-1`, and a singular value of it equals gamma exactly where the pencil

    [ A - s F     0                B          ]
    [ -C^T C      -A^T - s F^T     -C^T D     ]      (F, A, B, C, D a descriptor realisation of M_k on s = (z - 1) / (z + 1))
    [ D^T C       B^T              D^T D - gamma^2 ]

is singular for an imaginary s. The gain is evaluated at and between its eigenvalues until no level higher by more than the margin is met by
any unit, as in the norms of `core`. Pseudo-inverses need no inversion: for a tall P, `x = P^+ d` is `P~ (d - P x) = 0`, and for a wide one
`x = P~ y`, `P x = d`, with `P~` the adjoint system.

Eigenvalues are rounded. The pencil is therefore tried first at a level below the peak, where the grid knows all crossings: when it misses
one, the method is not used.

References
----------
N. A. Bruinsma and M. Steinbuch, "A fast algorithm to compute the H-infinity norm of a transfer function matrix",
Systems & Control Letters 14 (1990) 287-293.
"""

from __future__ import annotations

import logging
from collections.abc import Callable
from dataclasses import dataclass
from enum import Enum
from typing import Any

import numpy as np
import numpy.typing as npt

from ...core.frequency import nyquist_hz
from ...core.lti import StateSpace, gain
from ...core.norms import to_continuous
from ..fits.magnitude import invert
from ..forms import Form, as_form, residual_shape

Array = npt.NDArray[Any]
Ratio = Callable[[Array], Array]

_LOG = logging.getLogger(__name__)
_MARGIN = 1e-5
_LEVELS = 20
_PROBE = 0.9  # of the peak: the level at which the pencil is tried
_NEAR = 1e-3  # of its modulus: how far from the imaginary axis an eigenvalue may be
_MAXIMA, _FINER, _ZOOMS = 40, 20, 3
_LARGEST = 300  # rows of a pencil beyond which eigenvalues take too long


class Method(str, Enum):
    """How the bound between grid points is known."""

    GRID = "grid"
    LEVEL_SETS = "level sets"


@dataclass(frozen=True, eq=False)
class ResidualSystems:
    """The systems behind residuals, scaled as these are.

    Parameters
    ----------
    form : Form or str
    nominal : StateSpace
        Discrete, one system.
    units : StateSpace
        Discrete, the unit axis first.
    entry : tuple of int, optional
        Row and column of the residual where that entry alone is bounded.
    """

    form: Form | str
    nominal: StateSpace
    units: StateSpace
    entry: tuple[int, int] | None = None


@dataclass(frozen=True)
class Certificate:
    """Largest ratio over all frequencies.

    Parameters
    ----------
    method : Method
    peak : float
        Attained at `freq_hz`.
    freq_hz : float, Hz
    margin : float
        By level sets no frequency exceeds ``(1 + margin) * peak``; NaN on a grid, which proves nothing of the kind.
    """

    method: Method
    peak: float
    freq_hz: float
    margin: float


def certify(ratio: Ratio, freqs_hz: Array, left: StateSpace, right: StateSpace, systems: ResidualSystems | None = None) -> Certificate:
    """Find the largest ratio between residuals and weights over all frequencies from DC to Nyquist.

    Parameters
    ----------
    ratio : callable
        From frequencies (n,), Hz, to `sigma_max(W_L^-1 E_k W_R^-1)`, shape (unit, n).
    freqs_hz : ndarray, shape (frequency,), Hz
        Dense grid to start from.
    left, right : StateSpace
        Square weights with stable inverses.
    systems : ResidualSystems, optional
        For the test by level sets. Not for the inverse additive form.

    Returns
    -------
    Certificate
    """
    known = ratio(freqs_hz)
    freq, peak = _sharpened(ratio, freqs_hz, known.max(axis=0))
    pencils = [] if systems is None or peak <= 0 else _pencils(systems, left, right)
    if not pencils or not _trusted(pencils, freqs_hz, known, left.dt):
        return Certificate(Method.GRID, peak, freq, float("nan"))
    for _ in range(_LEVELS):
        found = np.unique(np.concatenate([_candidates(p, peak * (1 + _MARGIN), left.dt) for p in pencils]))
        values = ratio(found).max(axis=0) if found.size else np.zeros(1)
        top = int(values.argmax())
        if values[top] <= peak * (1 + _MARGIN):
            return Certificate(Method.LEVEL_SETS, peak, freq, _MARGIN)
        peak, freq = float(values[top]), float(found[top])
    return Certificate(Method.GRID, peak, freq, float("nan"))


def _sharpened(ratio: Ratio, freqs_hz: Array, known: Array) -> tuple[float, float]:
    """Frequency and height of the highest peak, asked again around the local maxima."""
    inner = np.concatenate([[-np.inf], known, [-np.inf]])
    tops = np.flatnonzero((known >= inner[:-2]) & (known >= inner[2:]))
    tops = tops[np.argsort(-known[tops])[:_MAXIMA]]
    low, high = freqs_hz[np.maximum(tops - 1, 0)], freqs_hz[np.minimum(tops + 1, len(freqs_hz) - 1)]
    best = float(freqs_hz[known.argmax()]), float(known.max())
    for _ in range(_ZOOMS):
        points = low[:, None] + (high - low)[:, None] * np.linspace(0, 1, _FINER + 1)
        values = ratio(points.ravel()).max(axis=0).reshape(points.shape)
        rows, columns = np.arange(len(points)), values.argmax(axis=1)
        row = int(values.max(axis=1).argmax())
        if values[row, columns[row]] > best[1]:
            best = float(points[row, columns[row]]), float(values[row, columns[row]])
        low, high = points[rows, np.maximum(columns - 1, 0)], points[rows, np.minimum(columns + 1, _FINER)]
    return best


@dataclass(frozen=True, eq=False)
class _Descriptor:
    """`s F x = A x + B u, y = C x + D u`."""

    F: Array
    A: Array
    B: Array
    C: Array
    D: Array

    @classmethod
    def of(cls, system: StateSpace) -> _Descriptor:
        return cls(np.eye(system.n_states), system.A, system.B, system.C, system.D)

    def __matmul__(self, first: _Descriptor) -> _Descriptor:
        """Series: the other one first."""
        none = np.zeros((len(first.A), len(self.A)))
        return _Descriptor(
            np.block([[first.F, none], [none.T, self.F]]),
            np.block([[first.A, none], [self.B @ first.C, self.A]]),
            np.vstack([first.B, self.B @ first.D]),
            np.hstack([self.D @ first.C, self.C]),
            self.D @ first.D,
        )

    def crossings(self, gamma: float) -> Array:
        """Eigenvalues s of the pencil at a level."""
        from scipy.linalg import eigvals

        n, m = self.B.shape
        left = np.block(
            [
                [self.A, np.zeros((n, n)), self.B],
                [-self.C.T @ self.C, -self.A.T, -self.C.T @ self.D],
                [self.D.T @ self.C, self.B.T, self.D.T @ self.D - gamma**2 * np.eye(m)],
            ]
        )
        right = np.zeros_like(left)
        right[:n, :n], right[n : 2 * n, n : 2 * n] = self.F, self.F.T
        for _ in range(6):
            for axis in (0, 1):
                size = np.maximum(np.abs(left).max(axis=axis, keepdims=True), np.abs(right).max(axis=axis, keepdims=True))
                scale = 2.0 ** -np.round(np.log2(np.where(size > 0, size, 1.0)) / 2)
                left, right = left * scale, right * scale
        with np.errstate(all="ignore"):
            found = eigvals(left, right)
        return found[np.isfinite(found)]


def _pencils(systems: ResidualSystems, left: StateSpace, right: StateSpace) -> list[_Descriptor]:
    """Realisation of `W_L^-1 E_k W_R^-1` for every unit; none where there is no exact test."""
    form, nominal, units = as_form(systems.form), systems.nominal, systems.units
    if form is Form.INVERSE_ADDITIVE:
        return []
    first, last = invert(right), invert(left)
    if systems.entry is not None:
        rows, columns = (np.eye(size) for size in residual_shape(form, nominal.n_outputs, nominal.n_inputs))
        first, last = gain(columns[:, [systems.entry[1]]], right.dt) @ first, last @ gain(rows[[systems.entry[0]]], left.dt)
    if form in (Form.OUTPUT_MULTIPLICATIVE, Form.INVERSE_OUTPUT_MULTIPLICATIVE):
        form, nominal, units, first, last = form.dual, _transposed(nominal), _transposed(units), _transposed(last), _transposed(first)
    G = to_continuous(nominal)
    before, after = (_Descriptor.of(to_continuous(w)) for w in (first, last))
    found = [after @ _residual(form, G, to_continuous(units[k])) @ before for k in range(units.batch_shape[0])]
    return found if 2 * len(found[0].A) + found[0].B.shape[1] <= _LARGEST else []


def _transposed(system: StateSpace) -> StateSpace:
    A, B, C, D = (np.swapaxes(x, -1, -2) for x in (system.A, system.C, system.B, system.D))
    return StateSpace(A, B, C, D, system.dt)


def _residual(form: Form, G: StateSpace, Gp: StateSpace) -> _Descriptor:
    """Residual of an additive or input-side form: with P inverted, N the other and v the sign, `P (w - v x) - N w` is orthogonal to P."""
    if form is Form.ADDITIVE:
        n, k = Gp.n_states, G.n_states
        A = np.block([[Gp.A, np.zeros((n, k))], [np.zeros((k, n)), G.A]])
        return _Descriptor(np.eye(n + k), A, np.vstack([Gp.B, G.B]), np.hstack([Gp.C, -G.C]), Gp.D - G.D)
    P, N, sign = (G, Gp, -1.0) if form is Form.INPUT_MULTIPLICATIVE else (Gp, G, 1.0)
    k, n, (p, m) = N.n_states, P.n_states, P.D.shape
    zero = np.zeros
    if p >= m:  # unknowns: states of N, P and the adjoint of P, then x; r = P (w - v x) - N w
        r = np.hstack([-N.C, P.C, zero((p, n)), -sign * P.D])
        r_w = P.D - N.D
        A = np.block(
            [
                [N.A, zero((k, 2 * n + m))],
                [zero((n, k)), P.A, zero((n, n)), -sign * P.B],
                [-P.C.T @ r],
                [P.D.T @ r],
            ]
        )
        A[k + n : k + 2 * n, k + n : k + 2 * n] -= P.A.T
        A[k + 2 * n :, k + n : k + 2 * n] += P.B.T
        B = np.vstack([N.B, P.B, -P.C.T @ r_w, P.D.T @ r_w])
        C = np.hstack([zero((m, k + 2 * n)), np.eye(m)])
        static = m
    else:  # unknowns: states of N, P and the adjoint of P, then y; x = P~ y and P (w - v x) = N w
        C = np.hstack([zero((m, k + n)), P.B.T, P.D.T])
        A = np.block(
            [
                [N.A, zero((k, 2 * n + p))],
                [np.hstack([zero((n, k)), P.A, zero((n, n + p))]) - sign * P.B @ C],
                [zero((n, k + n)), -P.A.T, -P.C.T],
                [np.hstack([-N.C, P.C, zero((p, n + p))]) - sign * P.D @ C],
            ]
        )
        B = np.vstack([N.B, P.B, zero((n, m)), P.D - N.D])
        static = p
    F = np.diag(np.concatenate([np.ones(k + 2 * n), zero(static)]))
    return _Descriptor(F, A, B, C, zero((m, m)))


def _candidates(pencil: _Descriptor, gamma: float, dt: float) -> Array:
    """Frequencies, Hz, at which a singular value may equal gamma, and points between them."""
    found = pencil.crossings(gamma)
    near = found[(np.abs(found.real) <= _NEAR * np.abs(found)) & (found.imag > 0)].imag
    points = np.unique(np.arctan(near) / (np.pi * dt))
    ends = np.concatenate([[0.0], points, [nyquist_hz(dt)]])
    return np.concatenate([ends, (ends[1:] + ends[:-1]) / 2, np.sqrt(points[1:] * points[:-1])])


def _trusted(pencils: list[_Descriptor], freqs_hz: Array, known: Array, dt: float) -> bool:
    """Whether the pencil of the worst unit has an eigenvalue at every crossing that the grid shows."""
    unit = int(known.max(axis=1).argmax())
    level = _PROBE * float(known[unit].max())
    above = known[unit] > level
    crossing = np.flatnonzero(above[1:] != above[:-1])
    found = pencils[unit].crossings(level)
    at = np.sort(np.arctan(found[(np.abs(found.real) <= _NEAR * np.abs(found)) & (found.imag > 0)].imag) / (np.pi * dt))
    low, high = freqs_hz[crossing] * (1 - _NEAR), freqs_hz[crossing + 1] * (1 + _NEAR)
    seen = np.searchsorted(at, high, side="right") > np.searchsorted(at, low)
    if not seen.all():
        _LOG.debug("Certificate: %d of %d crossings have no eigenvalue; the grid decides", (~seen).sum(), len(seen))
    return bool(seen.all())
