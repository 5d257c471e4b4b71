"""Physics of the drive, batched over trajectories.

    J_m dw/dt  = K_t (i - i_d) - F(w) - b w - k s - c (w - w_l)      motor and wave generator, referred to the output
    J_l dw_l/dt = k s + c (w - w_l) - m g l sin(q - s)               flange, and load where there is one
    ds/dt = w - w_l,   dq/dt = w,   tau di/dt = u - i

The linear part is integrated exactly over a substep (matrix exponential); friction `F`, disturbance `i_d` and gravity
are held, evaluated at the predicted middle of the substep.

Symbols
-------
q, w : motor angle and velocity / gear ratio;   s : gear twist;   w_l : flange velocity;   i, u : current and its
command p, v : position and velocity that the drive measures z : [s, w, w_l, i, u, f_m, f_l], shape (7, n);   M : map
from z to the next [s, w, w_l, i] and the step of q, shape (5, 7, n)
"""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt

from .parameters import GEAR_RATIO, SAMPLE_PERIOD_S, SMOOTHING_VELOCITY, DriveParameters

Array = npt.NDArray[Any]

SUBSTEPS = 2
SUBSTEP_S = SAMPLE_PERIOD_S / SUBSTEPS
TWIST, W, WL, CURRENT, COMMAND, FM, FL = range(7)
MEASURED = 2  # rows of p and v, in front of q and z
RECORDED = MEASURED + 1 + COMMAND  # rows from p to i
_HALF_STEP, _RATIO = np.array(0.5 * SUBSTEP_S), np.array(float(GEAR_RATIO))  # as NumPy makes of floats at every call
_SMOOTHING = np.array([[1.0], [SMOOTHING_VELOCITY**2]])  # of what fades with the velocity, and of its sign


def transition(p: DriveParameters, loaded: Array) -> Array:
    """Return the exact map over a substep, shape (n, 5, 7): from z to the next [s, w, w_l, i] and the step of q."""
    from scipy.linalg import expm

    n = len(p)
    Jm, Jl = p.motor_inertia, p.flange_inertia + loaded * p.load_inertia
    F = np.zeros((n, 8, 8))  # states s, w, w_l, i, q; held inputs u, f_m, f_l
    F[:, 0, 1], F[:, 0, 2] = 1.0, -1.0
    F[:, 1, 0], F[:, 1, 1], F[:, 1, 2] = -p.stiffness / Jm, -(p.damping + p.viscous_friction) / Jm, p.damping / Jm
    F[:, 1, 3], F[:, 1, 6] = p.torque_constant / Jm, 1.0 / Jm
    F[:, 2, 0], F[:, 2, 1], F[:, 2, 2] = p.stiffness / Jl, p.damping / Jl, -p.damping / Jl
    F[:, 2, 7] = 1.0 / Jl
    F[:, 3, 3], F[:, 3, 5] = -1.0 / p.current_lag_s, 1.0 / p.current_lag_s
    F[:, 4, 1] = 1.0
    Phi = expm(F * SUBSTEP_S)
    return Phi[:, :5][:, :, [0, 1, 2, 3, 5, 6, 7]]


class Physics:
    """State of a batch of trajectories and the code that moves it on by one sample, without allocating."""

    def __init__(self, p: DriveParameters, loaded: Array, q0: Array) -> None:
        n = len(p)
        self.p = p
        self.moment = loaded * p.load_moment
        self.M = np.ascontiguousarray(np.moveaxis(transition(p, loaded), 0, -1))
        self.ripple = np.ascontiguousarray((p.ripple * np.exp(1j * p.phase_rad)).T)
        self.rows = np.zeros((MEASURED + 1 + 7, n))  # side by side, so that recording a sample is one copy
        self.p_v, self.q, self.z = self.rows[:MEASURED], self.rows[MEASURED], self.rows[MEASURED + 1 :]
        self.q[:] = q0
        for _ in range(20):
            self.z[TWIST] = self.moment * np.sin(self.q - self.z[TWIST]) / p.stiffness
        self.z[CURRENT] = self.z[COMMAND] = p.stiffness * self.z[TWIST] / p.torque_constant + p.gearbox_current(self.q)
        self._highest, self._lower = self.ripple[-1], tuple(self.ripple[-2::-1])
        self._minus_constant, self._minus_moment = -p.torque_constant, -self.moment
        self._scales = np.stack([1.0 / p.stribeck_velocity, np.ones(n)])
        self._new = np.empty((5, n))
        self._a, self._b, self._squares = np.empty(n), np.empty(n), np.empty((2, n))
        self._angle, self._power = np.empty(n, complex), np.empty(n, complex)

    def advance(self) -> None:
        """Move on by one sampling period with the command in `z[COMMAND]` held."""
        q, z, a = self.q, self.z, self._a
        w, moved, new, step = z[W], z[:4], self._new[:4], self._new[4]
        for _ in range(SUBSTEPS):
            np.multiply(w, _HALF_STEP, a)
            np.add(q, a, a)  # q in the middle of the substep
            self._motor_torque(a)
            self._gravity(a)
            np.einsum("ijn,jn->in", self.M, z, out=self._new)
            moved[:] = new
            np.add(q, step, q)

    def _motor_torque(self, q: Array) -> None:
        """z[FM] = -K_t i_d(q) - F(w)."""
        f = self.z[FM]
        np.multiply(self._disturbance(q), self._minus_constant, f)
        np.subtract(f, self._friction(), f)

    def _disturbance(self, q: Array) -> Array:
        """(34): i_d is the imaginary part of sum_h a_h exp(j phi_h) exp(j h r q), by Horner's rule."""
        e, acc, add, multiply = self._angle, self._power, np.add, np.multiply
        multiply(q, _RATIO, self._b)
        np.cos(self._b, e.real)
        np.sin(self._b, e.imag)
        multiply(self._highest, e, acc)
        for coefficient in self._lower:
            add(acc, coefficient, acc)
            multiply(acc, e, acc)
        return acc.imag

    def _friction(self) -> Array:
        """F(w), as `DriveParameters.dry_friction` but in place."""
        w, squares = self.z[W], self._squares
        fade, width = squares
        np.multiply(self._scales, w, squares)
        np.multiply(squares, squares, squares)
        np.add(squares, _SMOOTHING, squares)
        np.divide(self.p.breakaway_torque, fade, fade)
        np.add(fade, self.p.coulomb_torque, fade)
        np.multiply(fade, w, fade)
        np.sqrt(width, width)
        np.divide(fade, width, fade)
        return fade

    def _gravity(self, q: Array) -> None:
        """z[FL] = -m g l sin(q - s)."""
        f = self.z[FL]
        np.subtract(q, self.z[TWIST], f)
        np.sin(f, f)
        np.multiply(f, self._minus_moment, f)


def load_torque(p: DriveParameters, recorded: Array) -> Array:
    """Torque that loads take from the flange, inertia and gravity, N m, shape (n_samples, n)."""
    q, z = recorded[MEASURED], recorded[MEASURED + 1 :]
    gravity = p.load_moment * np.sin(q - z[TWIST])
    acceleration = (p.stiffness * z[TWIST] + p.damping * (z[W] - z[WL]) - gravity) / (p.flange_inertia + p.load_inertia)
    return p.load_inertia * acceleration + gravity
