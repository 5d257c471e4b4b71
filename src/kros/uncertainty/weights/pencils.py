r"""Descriptor realisations of `W_L^-1 E_k W_R^-1`: of the residual of a form, or of what the form leaves out.

With N and P the nominal and a unit, P the one that the form inverts, the residual solves a least-squares problem, whose pseudo-inverse needs no
inversion: for a tall P, `x = P^+ d` is `P~ (d - P x) = 0`, and for a wide one `x = P~ y`, `P x = d`, with `P~` the adjoint system. The rest
`r = P (w - v x) - N w` of a tall P is what the form does not rebuild; an inverse form rebuilds from `(1 - E) w`, so that `w = u + x` there.

All systems are in `s = (z - 1) / (z + 1)`. Output-side forms are input-side ones of the transposed plants. The inverse additive form has no
realisation here.
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum
from typing import Any

import numpy as np
import numpy.typing as npt

from ...core.lti import StateSpace, gain
from ...core.norms import to_continuous
from ..fits.magnitude import invert
from ..forms import Form, as_form, residual_shape

Array = npt.NDArray[Any]

_LARGEST = 300  # rows of a pencil beyond which eigenvalues take too long
_LIGHT = 0.1  # damping up to which a mode is a peak or a notch
_AROUND = np.array([-3.0, -1.0, 0.0, 1.0, 3.0])  # half-widths
_APART = 0.5  # half-widths: modes nearer than this are one
_MOST = 400  # modes, the least damped ones first
_OUTPUT_SIDE = (Form.OUTPUT_MULTIPLICATIVE, Form.INVERSE_OUTPUT_MULTIPLICATIVE)


class Part(str, Enum):
    """Which part of the difference between units and nominal is bounded."""

    RESIDUAL = "residual"
    REMAINDER = "remainder"


@dataclass(frozen=True, eq=False)
class ResidualSystems:
    """The systems behind residuals, scaled as these are; discrete, units with the unit axis first."""

    form: Form | str
    nominal: StateSpace
    units: StateSpace
    entry: tuple[int, int] | None = None  # row and column of the residual where that entry alone is bounded
    part: Part = Part.RESIDUAL


@dataclass(frozen=True, eq=False)
class Descriptor:
    """`s F x = A x + B u, y = C x + D u`."""

    F: Array
    A: Array
    B: Array
    C: Array
    D: Array

    @classmethod
    def of(cls, system: StateSpace) -> Descriptor:
        """Return a system as a descriptor."""
        return cls(np.eye(system.n_states), system.A, system.B, system.C, system.D)

    def __matmul__(self, first: Descriptor) -> Descriptor:
        """Series: the other one first."""
        none = np.zeros((len(first.A), len(self.A)))
        return Descriptor(
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
                size = np.maximum(
                    np.abs(left).max(axis=axis, keepdims=True), np.abs(right).max(axis=axis, keepdims=True)
                )
                scale = 2.0 ** -np.round(np.log2(np.where(size > 0, size, 1.0)) / 2)
                left, right = left * scale, right * scale
        with np.errstate(all="ignore"):
            found = eigvals(left, right)
        return found[np.isfinite(found)]

    def poles(self) -> Array:
        """Return the finite eigenvalues of the pencil."""
        from scipy.linalg import eigvals

        with np.errstate(all="ignore"):
            found = eigvals(self.A, self.F)
        return np.asarray(found[np.isfinite(found)])


def ratio_systems(systems: ResidualSystems, left: StateSpace, right: StateSpace) -> list[Descriptor]:
    """Return `W_L^-1 E_k W_R^-1` for every unit; none where there is no exact realisation, or only a large one."""
    form, nominal = as_form(systems.form), systems.nominal
    if form is Form.INVERSE_ADDITIVE:
        return []
    first, last = invert(right), invert(left)
    if systems.entry is not None:
        rows, columns = (np.eye(size) for size in residual_shape(form, nominal.n_outputs, nominal.n_inputs))
        first, last = (
            gain(columns[:, [systems.entry[1]]], right.dt) @ first,
            last @ gain(rows[[systems.entry[0]]], left.dt),
        )
    if form in _OUTPUT_SIDE:
        first, last = _transposed(last), _transposed(first)
    before, after = (Descriptor.of(to_continuous(w)) for w in (first, last))
    parts = _of_units(systems, form)
    small = parts and 2 * len(parts[0].A) + parts[0].B.shape[1] + 2 * (len(before.A) + len(after.A)) <= _LARGEST
    return [after @ part @ before for part in parts] if small else []


def peaks_hz(systems: ResidualSystems, grid_hz: Array, sample_period_s: float) -> Array:
    """Return frequencies in and around every mode of the residuals that a grid from DC to Nyquist passes over, not beyond the grid."""
    form = as_form(systems.form)
    wide = systems.nominal.n_outputs < systems.nominal.n_inputs
    inverted = [Form.OUTPUT_MULTIPLICATIVE, Form.INVERSE_OUTPUT_MULTIPLICATIVE] if wide else []
    inverted = inverted or [Form.INPUT_MULTIPLICATIVE, Form.INVERSE_INPUT_MULTIPLICATIVE]
    forms = inverted if form is Form.INVERSE_ADDITIVE else [form]
    residual = ResidualSystems(form, systems.nominal, systems.units)
    plants = [
        to_continuous(s).poles()
        for s in (systems.nominal, *(systems.units[k] for k in range(systems.units.batch_shape[0])))
    ]
    modes = np.concatenate([part.poles() for f in forms for part in _of_units(residual, f)] + plants).astype(complex)
    light = modes[(modes.imag > 0) & (np.abs(modes.real) <= _LIGHT * np.abs(modes))]
    at_hz = np.arctan(light.imag) / (np.pi * sample_period_s)
    width = np.abs(light.real) / (1 + light.imag**2) / (np.pi * sample_period_s)
    light = light[(width < np.interp(at_hz, grid_hz, np.gradient(grid_hz))) & (at_hz <= grid_hz[-1])]
    light = light[np.argsort(np.abs(light.real) / np.abs(light), kind="stable")]
    kept: list[tuple[float, float]] = []
    for half, middle in zip(np.abs(light.real), light.imag, strict=True):
        if len(kept) < _MOST and all(abs(middle - other) > _APART * max(half, width) for width, other in kept):
            kept.append((float(half), float(middle)))
    if not kept:
        return np.zeros(0)
    halves, middles = np.array(kept).T
    omega = (middles[:, None] + halves[:, None] * _AROUND).ravel()
    found = np.unique(np.arctan(omega[omega > 0]) / (np.pi * sample_period_s))
    return found[found <= grid_hz[-1]]


def _of_units(systems: ResidualSystems, form: Form) -> list[Descriptor]:
    """Residual or remainder of every unit; none of a remainder that is rounding."""
    nominal, units = systems.nominal, systems.units
    if form in _OUTPUT_SIDE:
        form, nominal, units = form.dual, _transposed(nominal), _transposed(units)
    remainder = systems.part is Part.REMAINDER
    if remainder and (form is Form.ADDITIVE or nominal.n_outputs <= nominal.n_inputs):
        return []
    G = to_continuous(nominal)
    plants = (to_continuous(units[k]) for k in range(units.batch_shape[0]))
    return [_additive(G, Gp) if form is Form.ADDITIVE else _least_squares(form, G, Gp, remainder) for Gp in plants]


def _transposed(system: StateSpace) -> StateSpace:
    A, B, C, D = (np.swapaxes(x, -1, -2) for x in (system.A, system.C, system.B, system.D))
    return StateSpace(A, B, C, D, system.dt)


def _additive(G: StateSpace, Gp: StateSpace) -> Descriptor:
    n, k = Gp.n_states, G.n_states
    A = np.block([[Gp.A, np.zeros((n, k))], [np.zeros((k, n)), G.A]])
    return Descriptor(np.eye(n + k), A, np.vstack([Gp.B, G.B]), np.hstack([Gp.C, -G.C]), Gp.D - G.D)


def _least_squares(form: Form, G: StateSpace, Gp: StateSpace, remainder: bool) -> Descriptor:
    """Residual of an input-side form, or its remainder: with P inverted, N the other and v the sign, `P (w - v x) - N w` is orthogonal to P."""
    P, N, sign = (G, Gp, -1.0) if form is Form.INPUT_MULTIPLICATIVE else (Gp, G, 1.0)
    if P.D.shape[0] < P.D.shape[1]:
        return _wide(P, N, sign)
    k, n, (p, m) = N.n_states, P.n_states, P.D.shape
    zero = np.zeros
    # unknowns: states of N, P and the adjoint of P, then x; r = P (w - v x) - N w
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
    F = np.diag(np.concatenate([np.ones(k + 2 * n), zero(m)]))
    if not remainder:
        return Descriptor(F, A, B, np.hstack([zero((m, k + 2 * n)), np.eye(m)]), zero((m, m)))
    if form is Form.INPUT_MULTIPLICATIVE:
        return Descriptor(F, A, B, -r, -r_w)
    A[:, k + 2 * n :] += B  # w = u + x
    r[:, k + 2 * n :] += r_w
    return Descriptor(F, A, B, r, r_w)


def _wide(P: StateSpace, N: StateSpace, sign: float) -> Descriptor:
    """The same for more inputs than outputs: unknowns are states of N, P and the adjoint of P, then y; x = P~ y and P (w - v x) = N w."""
    k, n, (p, m) = N.n_states, P.n_states, P.D.shape
    zero = np.zeros
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
    F = np.diag(np.concatenate([np.ones(k + 2 * n), zero(p)]))
    return Descriptor(F, A, B, C, zero((m, m)))
