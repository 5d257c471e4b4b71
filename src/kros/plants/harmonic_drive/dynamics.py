"""Physics of the drive, batched over trajectories.

    J_m dw/dt  = K_t (i - i_d) - F(w) - b w - k s - c (w - w_l)      motor and wave generator, referred to the output
    J_l dw_l/dt = k s + c (w - w_l) - m g l sin(q - s)               flange, and load where there is one
    ds/dt = w - w_l,   dq/dt = w,   tau di/dt = u - i

The linear part is integrated exactly over a substep (matrix exponential); friction `F`, disturbance `i_d` and gravity
are held, evaluated at the predicted middle of the substep.

What a drive is made of, its software, and how the drives of a batch differ.

target position --> (+) --> Kp --> (+) --> PI --> limit --> current
                    -|    target velocity +|  -|
              position                     velocity = filtered difference of position

All mechanical quantities are referred to the gearbox output. Draws are log-normal around the nominal value; phases
are uniform. Each unit has its own random stream, so that unit `k` is the same whatever the number of units.

Symbols
-------
q, w : motor angle and velocity / gear ratio;   s : gear twist;   w_l : flange velocity;   i, u : current and its
command p, v : position and velocity that the drive measures z : [s, w, w_l, i, u, f_m, f_l], shape (7, n);   M : map
from z to the next [s, w, w_l, i] and the step of q, shape (5, 7, n)
"""

from __future__ import annotations

from dataclasses import dataclass, fields
from typing import Any

import numpy as np

from ...core import AnyArray, Array, frozen

GEAR_RATIO = 100
SAMPLE_PERIOD_S = 1e-3
COUNT_RAD = 2 * np.pi / (2**15 * GEAR_RATIO)  # of the encoder, whose counts are of a motor revolution, at the output
VELOCITY_POLE = float(np.exp(-2 * np.pi * 150.0 * SAMPLE_PERIOD_S))  # first-order filter at 150 Hz
CURRENT_NOISE = 2e-3  # standard deviation, fraction of full scale
SMOOTHING_VELOCITY = 0.02  # rad/s: width of the sign function of friction

# name: (nominal value, relative deviation at spread 1)
NOMINAL: dict[str, tuple[float, float]] = {
    "motor_inertia": (0.5, 0.05),
    "flange_inertia": (0.01, 0.05),
    "stiffness": (1.0e4, 0.10),
    "damping": (6.0, 0.15),
    "torque_constant": (40.0, 0.05),
    "current_lag_s": (3.0e-4, 0.10),
    "coulomb_torque": (3.2, 0.15),
    "breakaway_torque": (1.0, 0.15),
    "stribeck_velocity": (0.1, 0.15),
    "viscous_friction": (1.0, 0.15),
    "load_inertia": (0.4, 0.05),
    "load_moment": (8.0, 0.05),
}
# Amplitudes of (34) and of the fainter harmonics seen in Figure 4, as fractions of the full-scale current.
RIPPLE = np.array([6.0e-2, 6.0e-3, 4.0e-3, 3.0e-3, 2.4e-3, 2.0e-3, 1.7e-3, 1.5e-3])
RIPPLE_DEVIATION = 0.15

# Loose fasteners: factor on each parameter at severity s is exp(s * value).
OUTLIER_LOG_FACTORS = {
    "stiffness": -1.2,
    "damping": -0.6,
    "coulomb_torque": 0.3,
    "breakaway_torque": 0.3,
    "viscous_friction": 0.4,
    "ripple": 0.6,
}


@dataclass(frozen=True)
class Gains:
    """Controller gains."""

    position: float  # 1/s
    velocity: float  # fraction of full scale per rad/s
    integral: float  # fraction of full scale per rad
    antiwindup: float = 0.05  # share of the excess over the current limit that is taken off the integrator each sample


GAINS = {  # of a stiff and of a soft velocity loop
    "stiff": Gains(position=25.0, velocity=3.75, integral=110.0),
    "soft": Gains(position=15.0, velocity=1.5, integral=25.0),
}


@frozen
class DriveParameters:
    """Physical parameters of a batch of drives; every field has the unit axis first."""

    motor_inertia: Array  # shape (n_units,), kg m^2; rotor and wave generator, times the squared gear ratio
    flange_inertia: Array  # shape (n_units,), kg m^2; output flange without load
    stiffness: Array  # shape (n_units,), N m/rad; of the gear (flexspline)
    damping: Array  # shape (n_units,), N m s/rad; of the gear
    torque_constant: Array  # shape (n_units,), N m; torque at full-scale current
    current_lag_s: Array  # shape (n_units,), s; time constant of the current loop
    coulomb_torque: Array  # shape (n_units,), N m
    breakaway_torque: Array  # shape (n_units,), N m; what breakaway adds to Coulomb friction at standstill
    stribeck_velocity: Array  # shape (n_units,), rad/s; where half of the breakaway torque is left
    viscous_friction: Array  # shape (n_units,), N m s/rad
    load_inertia: Array  # shape (n_units,), kg m^2; of the asymmetric load, about the output axis
    load_moment: Array  # shape (n_units,), N m; mass times gravity times lever arm of the asymmetric load
    ripple: Array  # shape (n_units, n_harmonics), fraction of full-scale current; amplitudes `a1, a2, ...` of (34)
    phase_rad: Array  # shape (n_units, n_harmonics), rad; phases `phi1, phi2, ...` of (34), in [0, 2 pi)

    def __len__(self) -> int:
        return len(self.motor_inertia)

    def take(self, rows: Any) -> DriveParameters:
        """Return the parameters of some units, or of the same unit several times."""
        return DriveParameters(**{f.name: getattr(self, f.name)[rows] for f in fields(self)})

    def dry_friction(self, velocity: Array) -> Array:
        """Coulomb and Stribeck friction of each unit at its own velocity, with a smooth sign, shape (n_units,), N m."""
        fade = (1.0 / self.stribeck_velocity * velocity) ** 2 + 1.0
        torque = self.breakaway_torque / fade + self.coulomb_torque
        return torque * velocity / np.sqrt(velocity**2 + SMOOTHING_VELOCITY**2)


SUBSTEPS = 2
SUBSTEP_S = SAMPLE_PERIOD_S / SUBSTEPS
TWIST, W, WL, CURRENT, COMMAND, FM, FL = range(7)
MEASURED = 2  # rows of p and v, in front of q and z
RECORDED = MEASURED + 1 + COMMAND  # rows from p to i
BLOCK_SAMPLES = 32  # recorded time-major, then turned into one row per trajectory
_SIGNALS = (0, 1, MEASURED + 1 + CURRENT)  # recorded rows of position, velocity and current


def transition(p: DriveParameters, loaded: AnyArray) -> AnyArray:
    """Return the exact map over a substep, shape (n, 5, 7): from z to the next [s, w, w_l, i] and the step of q."""
    from scipy.linalg import expm

    n = len(p)
    Jm, Jl = p.motor_inertia, p.flange_inertia + loaded * p.load_inertia
    F = np.zeros((n, 8, 8))  # states s, w, w_l, i, q; held inputs u, f_m, f_l
    q, u = COMMAND, COMMAND + 1  # places in F, where what is held comes behind q
    F[:, TWIST, W], F[:, TWIST, WL] = 1.0, -1.0
    F[:, W, TWIST], F[:, W, W], F[:, W, WL] = -p.stiffness / Jm, -(p.damping + p.viscous_friction) / Jm, p.damping / Jm
    F[:, W, CURRENT], F[:, W, FM + 1] = p.torque_constant / Jm, 1.0 / Jm
    F[:, WL, TWIST], F[:, WL, W], F[:, WL, WL] = p.stiffness / Jl, p.damping / Jl, -p.damping / Jl
    F[:, WL, FL + 1] = 1.0 / Jl
    F[:, CURRENT, CURRENT], F[:, CURRENT, u] = -1.0 / p.current_lag_s, 1.0 / p.current_lag_s
    F[:, q, W] = 1.0
    Phi = expm(F * SUBSTEP_S)
    return np.delete(Phi[:, :u], q, axis=2)


class Physics:
    """State of a batch of trajectories and the code that moves it on by one sample."""

    def __init__(self, p: DriveParameters, loaded: AnyArray, q0: AnyArray) -> None:
        n = len(p)
        self.p, self.moment = p, loaded * p.load_moment
        self.M = np.ascontiguousarray(np.moveaxis(transition(p, loaded), 0, -1))
        self.ripple = np.ascontiguousarray((p.ripple * np.exp(1j * p.phase_rad)).T)
        self.rows = np.zeros((MEASURED + 2 + FL, n))  # side by side, so that recording a sample is one copy
        self.p_v, self.q, self.z = self.rows[:MEASURED], self.rows[MEASURED], self.rows[MEASURED + 1 :]
        self.q[:] = q0
        for _ in range(20):
            self.z[TWIST] = self.moment * np.sin(self.q - self.z[TWIST]) / p.stiffness
        self.z[CURRENT] = self.z[COMMAND] = p.stiffness * self.z[TWIST] / p.torque_constant + self.disturbance(q0)

    def advance(self) -> None:
        """Move on by one sampling period with the command in `z[COMMAND]` held."""
        q, z = self.q, self.z
        for _ in range(SUBSTEPS):
            middle = q + z[W] * (0.5 * SUBSTEP_S)
            z[FM] = self.disturbance(middle) * -self.p.torque_constant - self.p.dry_friction(z[W])
            z[FL] = np.sin(middle - z[TWIST]) * -self.moment
            moved = np.einsum("ijn,jn->in", self.M, z)
            z[:4] = moved[:4]
            q += moved[4]

    def disturbance(self, q: AnyArray) -> AnyArray:
        """Return i_d of (34), a fraction of full scale: Im sum_h a_h exp(j phi_h) exp(j h r q), by Horner's rule."""
        angle = q * GEAR_RATIO
        e = np.cos(angle) + 1j * np.sin(angle)
        total = self.ripple[-1] * e
        for coefficient in self.ripple[-2::-1]:
            total = (total + coefficient) * e
        return total.imag


def load_torque(p: DriveParameters, recorded: AnyArray) -> AnyArray:
    """Torque that loads take from the flange, inertia and gravity, N m, shape (n_samples, n)."""
    q, z = recorded[MEASURED], recorded[MEASURED + 1 :]
    gravity = p.load_moment * np.sin(q - z[TWIST])
    acceleration = (p.stiffness * z[TWIST] + p.damping * (z[W] - z[WL]) - gravity) / (p.flange_inertia + p.load_inertia)
    return p.load_inertia * acceleration + gravity


def simulate(
    p: DriveParameters, loaded: AnyArray, reference: AnyArray, targets: tuple[AnyArray, AnyArray], gains: Gains
) -> tuple[AnyArray, AnyArray, AnyArray]:
    """Simulate all trajectories; `targets` are position (rad) and velocity (rad/s), shape (n_references, n_samples).

    Returned are states, shape (n, 3, n_samples): quantised position, its filtered difference, current without noise;
    the true velocity of the motor, rad/s, shape (n, 1, n_samples); and the load torque taken from the flange, a share
    of full-scale current, shape (n_loaded, n_samples), float32.
    """
    n, n_samples, is_loaded = len(p), targets[0].shape[1], np.flatnonzero(loaded)
    states, velocity = np.empty((n, len(_SIGNALS), n_samples)), np.empty((n, 1, n_samples))
    load_signals = np.empty((len(is_loaded), n_samples), np.float32)
    physics = Physics(p, loaded, targets[0][reference, 0])
    drive, with_load = _Controller(physics, gains), p.take(is_loaded)
    recorded = np.empty((BLOCK_SAMPLES, RECORDED, n))
    for first in range(0, n_samples, BLOCK_SAMPLES):
        stop = min(first + BLOCK_SAMPLES, n_samples)
        rp, rv = (np.ascontiguousarray(target[:, first:stop].T)[:, reference] for target in targets)
        for k in range(stop - first):
            drive.sample(rp[k], rv[k])
            recorded[k] = physics.rows[:RECORDED]
            physics.advance()
        block = recorded[: stop - first]
        for row, signal in enumerate(_SIGNALS):
            states[:, row, first:stop] = block[:, signal].T
        velocity[:, 0, first:stop] = block[:, MEASURED + 1 + W].T
        torque = load_torque(with_load, block[..., is_loaded].swapaxes(0, 1))
        load_signals[:, first:stop] = (torque / with_load.torque_constant).T
    return states, velocity, load_signals


class _Controller:
    """Encoder, velocity estimate and cascaded control of a batch; writes measurement and command into the physics."""

    def __init__(self, physics: Physics, gains: Gains) -> None:
        self.physics, self.gains = physics, gains
        self.p, self.v = physics.p_v
        self.p[:] = np.rint(physics.q / COUNT_RAD) * COUNT_RAD
        self._integral = physics.z[COMMAND].copy()

    def sample(self, rp: AnyArray, rv: AnyArray) -> None:
        """Measure, and set the command for the coming sampling period."""
        gains, u = self.gains, self.physics.z[COMMAND]
        position = np.rint(self.physics.q * (1.0 / COUNT_RAD)) * COUNT_RAD
        slope = (position - self.p) * ((1.0 - VELOCITY_POLE) / SAMPLE_PERIOD_S)
        self.v *= VELOCITY_POLE
        self.v += slope
        self.p[:] = position
        error = (rp - self.p) * gains.position + rv - self.v
        raw = error * gains.velocity + self._integral
        u[:] = np.minimum(np.maximum(raw, -1.0), 1.0)
        self._integral += error * (gains.integral * SAMPLE_PERIOD_S)
        self._integral += (u - raw) * gains.antiwindup
