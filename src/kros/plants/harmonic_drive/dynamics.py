"""Physics of the drive, batched over trajectories.

    J_m dw/dt  = K_t (i - i_d) - F(w) - b w - k s - c (w - w_l)      motor and wave generator, referred to the output
    J_l dw_l/dt = k s + c (w - w_l) - m g l sin(q - s)               flange, and load where there is one
    ds/dt = w - w_l,   dq/dt = w,   tau di/dt = u - i

The linear part is integrated exactly over a substep (matrix exponential); friction `F`, disturbance `i_d` and gravity are held,
evaluated at the predicted middle of the substep.

Symbols
-------
q, w : motor angle and velocity / gear ratio;   s : gear twist;   w_l : flange velocity;   i, u : current and its command
z : [s, w, w_l, i, u, f_m, f_l], shape (7, n);   M : map from z to the next [s, w, w_l, i] and the step of q, shape (5, 7, n)
"""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt

from .control import SAMPLE_PERIOD_S
from .parameters import GEAR_RATIO, SMOOTHING_VELOCITY, DriveParameters

Array = npt.NDArray[Any]

SUBSTEPS = 2
SUBSTEP_S = SAMPLE_PERIOD_S / SUBSTEPS
TWIST, W, WL, CURRENT, COMMAND, FM, FL = range(7)


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
    """State of a batch of trajectories and the code that moves it on by one sample, without allocating.

    Parameters
    ----------
    p : DriveParameters
        One row per trajectory.
    loaded : ndarray, shape (n,)
        One where the asymmetric load is mounted, zero elsewhere.
    q0 : ndarray, shape (n,), rad
        Angle at which the drive is at rest at the start, in equilibrium with gravity and gearbox.
    """

    def __init__(self, p: DriveParameters, loaded: Array, q0: Array) -> None:
        n = len(p)
        self.p = p
        self.moment = loaded * p.load_moment
        self.M = np.ascontiguousarray(np.moveaxis(transition(p, loaded), 0, -1))
        self.ripple = np.ascontiguousarray((p.ripple * np.exp(1j * p.phase_rad)).T)
        self.z = np.zeros((7, n))
        self.q = q0.astype(float).copy()
        for _ in range(20):
            self.z[TWIST] = self.moment * np.sin(self.q - self.z[TWIST]) / p.stiffness
        self.z[CURRENT] = self.z[COMMAND] = p.stiffness * self.z[TWIST] / p.torque_constant + p.gearbox_current(self.q)
        self._inverse_stribeck = 1.0 / p.stribeck_velocity
        self._new = np.empty((5, n))
        self._a, self._b, self._c = np.empty(n), np.empty(n), np.empty(n)
        self._angle, self._power = np.empty(n, complex), np.empty(n, complex)

    def advance(self) -> None:
        """Move on by one sampling period with the command in `z[COMMAND]` held."""
        z, a = self.z, self._a
        for _ in range(SUBSTEPS):
            np.multiply(z[W], 0.5 * SUBSTEP_S, out=a)
            np.add(self.q, a, out=a)  # q in the middle of the substep
            self._motor_torque(a)
            self._gravity(a)
            np.einsum("ijn,jn->in", self.M, z, out=self._new)
            z[:4] = self._new[:4]
            np.add(self.q, self._new[4], out=self.q)

    def _motor_torque(self, q: Array) -> None:
        """z[FM] = -K_t i_d(q) - F(w)."""
        f = self.z[FM]
        np.multiply(self._disturbance(q), self.p.torque_constant, out=f)
        np.add(f, self._friction(), out=f)
        np.negative(f, out=f)

    def _disturbance(self, q: Array) -> Array:
        """(34): i_d is the imaginary part of sum_h a_h exp(j phi_h) exp(j h r q), by Horner's rule."""
        e, acc = self._angle, self._power
        np.multiply(q, GEAR_RATIO, out=self._b)
        np.cos(self._b, out=e.real)
        np.sin(self._b, out=e.imag)
        np.copyto(acc, self.ripple[-1])
        for coefficient in self.ripple[-2::-1]:
            np.multiply(acc, e, out=acc)
            np.add(acc, coefficient, out=acc)
        np.multiply(acc, e, out=acc)
        return acc.imag

    def _friction(self) -> Array:
        """F(w), as `DriveParameters.dry_friction` but in place."""
        w, fade, width = self.z[W], self._b, self._c
        np.multiply(w, self._inverse_stribeck, out=fade)
        np.multiply(fade, fade, out=fade)
        np.add(fade, 1.0, out=fade)
        np.divide(self.p.breakaway_torque, fade, out=fade)
        np.add(fade, self.p.coulomb_torque, out=fade)
        np.multiply(fade, w, out=fade)
        np.multiply(w, w, out=width)
        np.add(width, SMOOTHING_VELOCITY**2, out=width)
        np.sqrt(width, out=width)
        np.divide(fade, width, out=fade)
        return fade

    def _gravity(self, q: Array) -> None:
        """z[FL] = -m g l sin(q - s)."""
        f = self.z[FL]
        np.subtract(q, self.z[TWIST], out=f)
        np.sin(f, out=f)
        np.multiply(f, self.moment, out=f)
        np.negative(f, out=f)

    def load_torque(self, inertia: Array, total_inertia: Array) -> Array:
        """Torque that the load takes from the flange now, inertia and gravity, shape (n,), N m."""
        p, z = self.p, self.z
        gravity = self.moment * np.sin(self.q - z[TWIST])
        acceleration = (p.stiffness * z[TWIST] + p.damping * (z[W] - z[WL]) - gravity) / total_inertia
        return inertia * acceleration + gravity
