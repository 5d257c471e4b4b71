"""A batch of brushed DC motors behind amplifiers with a current limit: three states whose ranges differ a thousandfold.

    L di/dt = v - R i - k w,   |i| <= limit
    J dw/dt = k i - b w - c tanh(w / w_s)
      dp/dt = w

The input `v` is a pseudorandom voltage; every level is followed by its opposite, so that the shaft comes back.
Position comes from an encoder, velocity and current from noisy sensors. `tanh(velocity)` lifts the Coulomb friction
exactly.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import ClassVar

import numpy as np
import numpy.typing as npt

from ..data.population import Channel, Role
from .batch import Batch, UnitTruth, runge_kutta

Array = npt.NDArray[np.float64]

SAMPLE_PERIOD_S = 0.002
VELOCITY_NOISE = 0.1  # rad/s, standard deviation
CURRENT_NOISE = 0.01  # A, standard deviation
CURRENT_LIMIT_A = 8.0
SLIP_RAD_S = 1.0  # w_s: below it friction is viscous
HOLD_SAMPLES = (50, 200)  # shortest and longest level of the input
VOLTAGE_V = 12.0
PARAMETERS = {  # nominal value, relative deviation
    "resistance": (1.0, 0.05),
    "inductance": (5e-3, 0.08),
    "torque_constant": (0.05, 0.05),
    "inertia": (1e-4, 0.05),
    "viscous": (1e-4, 0.15),
    "coulomb": (1e-2, 0.15),
}
OUTLIER_LOG_FACTORS = {"torque_constant": -0.25, "viscous": 0.8, "coulomb": 1.0}  # a tired magnet and a dry bearing
CHANNELS = (
    Channel("position", Role.STATE, "rad", measured=True),
    Channel("velocity", Role.STATE, "rad/s"),
    Channel("current", Role.STATE, "A"),
    Channel("voltage", Role.INPUT, "V"),
)
# what the noisy sensors see
TRUTHS = tuple(Channel(f"{c.name}_true", Role.TRUTH, c.unit, of=c.name) for c in CHANNELS[1:3])


@dataclass(frozen=True, eq=False)
class DcMotorTruth(UnitTruth):
    """True parameters of the motors."""

    resistance: Array  # shape (n_units,), ohm
    inductance: Array  # shape (n_units,), H
    torque_constant: Array  # shape (n_units,), N m/A; also the constant of the back electromotive force, V s/rad
    inertia: Array  # shape (n_units,), kg m^2
    viscous: Array  # shape (n_units,), N m s/rad
    coulomb: Array  # shape (n_units,), N m
    plant: ClassVar[str] = "dc-motor"

    def respond(self, voltage: Array) -> Array:
        """Simulate all motors from rest, without sensors, shape (3, n_units, n_episodes, n_samples)."""
        start = np.zeros((3, len(self.unit_ids), len(voltage)))
        return runge_kutta(self._rates, start, voltage, SAMPLE_PERIOD_S, _limited)

    def _rates(self, x: Array, voltage: Array) -> Array:
        R, L, k, J, b, c = (getattr(self, name)[:, None] for name in PARAMETERS)
        _, w, i = x
        return np.stack([w, (k * i - b * w - c * np.tanh(w / SLIP_RAD_S)) / J, (voltage - R * i - k * w) / L])


class DcMotorPopulation(Batch[DcMotorTruth]):
    """Settings of a simulated batch of DC motors, see `BatchSettings`; a spread of 1 means deviations of 5 to 15 %.

    The outlier has a tired magnet and a dry bearing.

    Examples
    --------
    >>> from kros.plants import DcMotorPopulation
    >>> motors = DcMotorPopulation(n_units=3, n_episodes=2, seconds=1.0, seed=3, outlier=True).simulate()
    >>> [unit.group for unit in motors.population.units]
    ['outliers', 'population', 'population', 'population']
    """

    plant = "dc-motor"
    channels, truths, sample_period_s, noise = CHANNELS, TRUTHS, SAMPLE_PERIOD_S, (VELOCITY_NOISE, CURRENT_NOISE)
    parameters, outlier_log_factors = PARAMETERS, OUTLIER_LOG_FACTORS

    def truth(self, unit_ids: tuple[str, ...], values: Mapping[str, Array]) -> DcMotorTruth:
        """Return the motors."""
        return DcMotorTruth(unit_ids, **values)

    def reference(self, rng: np.random.Generator, n_samples: int) -> Array:
        """Voltages of random size, each held for a random time and followed by its opposite for the same time."""
        pairs = n_samples // (2 * HOLD_SAMPLES[0]) + 1
        lengths, levels = rng.integers(*HOLD_SAMPLES, size=pairs), rng.uniform(-VOLTAGE_V, VOLTAGE_V, pairs)
        return np.repeat(np.stack([levels, -levels], axis=1).ravel(), np.repeat(lengths, 2))[:n_samples]

    def respond(self, truth: DcMotorTruth, inputs: Array) -> Array:
        """Return position, velocity and current from rest."""
        return truth.respond(inputs)


def _limited(x: Array) -> Array:
    """Keep the current within what the amplifier gives."""
    x[2] = np.clip(x[2], -CURRENT_LIMIT_A, CURRENT_LIMIT_A)
    return x
