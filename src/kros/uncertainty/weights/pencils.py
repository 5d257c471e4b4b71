r"""Descriptor systems of residuals, of what forms leave out, and of their ratios to weights.

`s F x = A x + B u, y = C x + D u` with `s = (z - 1) / (z + 1)`. Sums, products and inverses of descriptors are
descriptors, and so is a pseudo-inverse, with P~ the adjoint system: for a tall P, `x = P^+ d` is `P~ (d - P x) = 0`,
and for a wide one `x = P~ y`, `P x = d`. The formulas of `forms` are written with them.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from ...core.lti import StateSpace
from ...core.norms import to_continuous
from ..forms import Form
from ..settings import PROOF

Array = npt.NDArray[Any]

OUTPUT_SIDE = (Form.OUTPUT_MULTIPLICATIVE, Form.INVERSE_OUTPUT_MULTIPLICATIVE)


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
        """Return a discrete system."""
        mapped = to_continuous(system)
        return cls(np.eye(mapped.n_states), mapped.A, mapped.B, mapped.C, mapped.D)

    @classmethod
    def identity(cls, size: int) -> Descriptor:
        """Return ones."""
        none = np.zeros((0, 0))
        return cls(none, none, np.zeros((0, size)), np.zeros((size, 0)), np.eye(size))

    def __matmul__(self, first: Descriptor) -> Descriptor:
        """Return the series connection, the other one first."""
        none = np.zeros((len(first.A), len(self.A)))
        return Descriptor(
            np.block([[first.F, none], [none.T, self.F]]),
            np.block([[first.A, none], [self.B @ first.C, self.A]]),
            np.vstack([first.B, self.B @ first.D]),
            np.hstack([self.D @ first.C, self.C]),
            self.D @ first.D,
        )

    def __sub__(self, other: Descriptor) -> Descriptor:
        """Return the difference of two systems with the same input."""
        none = np.zeros((len(self.A), len(other.A)))
        return Descriptor(
            np.block([[self.F, none], [none.T, other.F]]),
            np.block([[self.A, none], [none.T, other.A]]),
            np.vstack([self.B, other.B]),
            np.hstack([self.C, -other.C]),
            self.D - other.D,
        )

    def inverse(self) -> Descriptor:
        """Return the inverse of a square system: its input is one more unknown, `C x + D u = y`."""
        n, m = self.B.shape
        F = np.diag(np.zeros(n + m))
        F[:n, :n] = self.F
        A = np.block([[self.A, self.B], [self.C, self.D]])
        B = np.vstack([np.zeros((n, m)), -np.eye(m)])
        return Descriptor(F, A, B, np.hstack([np.zeros((m, n)), np.eye(m)]), np.zeros((m, m)))

    def pseudo_inverse(self) -> Descriptor:
        """Return the least-squares or least-norm inverse of a system with F = 1, by its adjoint system."""
        n, (p, m) = len(self.A), self.D.shape
        zero = np.zeros
        if p >= m:  # unknowns: states, adjoint states, x; P~ r = 0 with r = d - P x
            r = np.hstack([-self.C, zero((p, n)), -self.D])
            A = np.block([[self.A, zero((n, n)), self.B], [-self.C.T @ r], [self.D.T @ r]])
            A[n : 2 * n, n : 2 * n] -= self.A.T
            A[2 * n :, n : 2 * n] += self.B.T
            B = np.vstack([zero((n, p)), -self.C.T, self.D.T])
            C = np.hstack([zero((m, 2 * n)), np.eye(m)])
        else:  # unknowns: states, adjoint states, y; x = P~ y and P x = d
            C = np.hstack([zero((m, n)), self.B.T, self.D.T])
            top = np.hstack([self.A, zero((n, n + p))]) + self.B @ C
            middle = np.hstack([zero((n, n)), -self.A.T, -self.C.T])
            A = np.vstack([top, middle, np.hstack([self.C, zero((p, n + p))]) + self.D @ C])
            B = np.vstack([zero((2 * n, p)), -np.eye(p)])
        F = np.diag(np.concatenate([np.ones(2 * n), zero(min(p, m))]))
        return Descriptor(F, A, B, C, zero((m, p)))

    def crossings(self, gamma: float) -> Array:
        r"""Return the s at which a singular value may equal gamma.

        They are the finite eigenvalues of

        [ A - s F     0                B                ]
        [ -C^T C      -A^T - s F^T     -C^T D           ]
        [ D^T C       B^T              D^T D - gamma^2  ]
        """
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
        return _eigenvalues(left, right)

    def poles(self) -> Array:
        """Return the finite eigenvalues of the pencil."""
        return _eigenvalues(self.A, self.F)


def _eigenvalues(left: Array, right: Array) -> Array:
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
    return np.asarray(values[np.isfinite(values)])


@dataclass(frozen=True, eq=False)
class ResidualSystems:
    """The discrete systems behind residuals, scaled as these are; units with the unit axis first."""

    form: Form
    nominal: StateSpace
    units: StateSpace
    remainder: bool = False  # what the form leaves out is bounded in place of the residual

    def __iter__(self) -> Iterator[Descriptor]:
        G = Descriptor.of(self.nominal)
        for k in range(self.units.batch_shape[0]):
            Gp = Descriptor.of(self.units[k])
            yield _remainder(self.form, G, Gp) if self.remainder else _residual(self.form, G, Gp)

    def ratios(self, left: StateSpace, right: StateSpace) -> list[Descriptor]:
        """Return `W_L^-1 E_k W_R^-1` for every unit; none where pencils are large or nothing is left out."""
        if self.remainder and leaves_nothing(self.form, self.nominal.n_outputs, self.nominal.n_inputs):
            return []
        before, after = (Descriptor.of(invert(w)) for w in (right, left))
        parts = [after @ part @ before for part in self]
        return parts if 2 * len(parts[0].A) + parts[0].B.shape[1] <= PROOF.rows else []

    def modes_hz(self, grid_hz: Array) -> Array:
        """Return frequencies in and around every mode of residuals and plants."""
        dt = self.nominal.dt
        plants = (self.nominal, *(self.units[k] for k in range(self.units.batch_shape[0])))
        systems = (*self, *map(Descriptor.of, plants))
        modes = np.concatenate([system.poles() for system in systems]).astype(complex)
        light = modes[(modes.imag > 0) & (np.abs(modes.real) <= PROOF.light * np.abs(modes))]
        at_hz = np.arctan(light.imag) / (np.pi * dt)
        width = np.abs(light.real) / (1 + light.imag**2) / (np.pi * dt)
        light = light[(width < np.interp(at_hz, grid_hz, np.gradient(grid_hz))) & (at_hz <= grid_hz[-1])]
        light = light[np.argsort(np.abs(light.real) / np.abs(light), kind="stable")]
        apart: list[tuple[float, float]] = []
        for half, middle in zip(np.abs(light.real), light.imag, strict=True):
            if len(apart) < PROOF.modes and all(abs(middle - other) > PROOF.apart * max(half, w) for w, other in apart):
                apart.append((float(half), float(middle)))
        halves, middles = np.array(apart).reshape(-1, 2).T
        omega = (middles[:, None] + halves[:, None] * PROOF.around).ravel()
        found = np.unique(np.arctan(omega[omega > 0]) / (np.pi * dt))
        return found[found <= grid_hz[-1]]


def leaves_nothing(form: Form, n_outputs: int, n_inputs: int) -> bool:
    """Tell whether a form rebuilds every regular unit of a shape exactly."""
    if form in (Form.ADDITIVE, Form.INVERSE_ADDITIVE):
        return form is Form.ADDITIVE or n_outputs == n_inputs
    return n_outputs >= n_inputs if form in OUTPUT_SIDE else n_outputs <= n_inputs


def _residual(form: Form, G: Descriptor, Gp: Descriptor) -> Descriptor:
    """Return the residual of a form, as in `forms.residual`."""
    difference = Gp - G
    if form is Form.ADDITIVE:
        return difference
    inverse = (Gp if form.inverse else G).pseudo_inverse()
    if form in OUTPUT_SIDE:
        return difference @ inverse
    return inverse @ difference @ G.pseudo_inverse() if form is Form.INVERSE_ADDITIVE else inverse @ difference


def _remainder(form: Form, G: Descriptor, Gp: Descriptor) -> Descriptor:
    """Return the remainder of a form: the unit minus what `forms.rebuild` makes of the residual."""
    E = _residual(form, G, Gp)
    if not form.inverse:
        return (Gp - G) - (E @ G if form in OUTPUT_SIDE else G @ E)
    loop = E @ G if form is Form.INVERSE_ADDITIVE else E
    inverse = (Descriptor.identity(len(loop.D)) - loop).inverse()
    return Gp - (inverse @ G if form is Form.INVERSE_OUTPUT_MULTIPLICATIVE else G @ inverse)


def invert(system: StateSpace) -> StateSpace:
    """Return the inverse of a square system with a regular feedthrough."""
    D = np.linalg.inv(system.D)
    B = system.B @ D
    return StateSpace(system.A - B @ system.C, B, -D @ system.C, D, system.dt)
