"""What a drive is made of, its software, and how the drives of a batch differ.

target position --> (+) --> Kp --> (+) --> PI --> limit --> current
                    -|    target velocity +|  -|
              position                     velocity = filtered difference of position

All mechanical quantities are referred to the gearbox output. Draws are log-normal around the nominal value; phases
are uniform. Each unit has its own random stream, so that unit `k` is the same whatever the number of units.
"""

from __future__ import annotations

from dataclasses import dataclass, fields
from enum import Enum
from typing import Any

import numpy as np

from ...core.arrays import Array, frozen

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


class Loop(str, Enum):
    """How stiff the velocity loop is."""

    STIFF = "stiff"
    SOFT = "soft"


@dataclass(frozen=True)
class Gains:
    """Controller gains."""

    position: float  # 1/s
    velocity: float  # fraction of full scale per rad/s
    integral: float  # fraction of full scale per rad
    antiwindup: float = 0.05  # share of the excess over the current limit that is taken off the integrator each sample


GAINS = {
    Loop.STIFF: Gains(position=25.0, velocity=3.75, integral=110.0),
    Loop.SOFT: Gains(position=15.0, velocity=1.5, integral=25.0),
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
