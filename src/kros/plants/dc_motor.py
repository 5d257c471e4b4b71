"""A batch of brushed DC motors behind amplifiers with a current limit: three states whose ranges differ a thousandfold.

    L di/dt = v - R i - k w,   |i| <= limit
    J dw/dt = k i - b w - c tanh(w / w_s)
      dp/dt = w

The input `v` is a pseudorandom voltage; every level is followed by its opposite, so that the shaft comes back.
Position comes from an encoder, velocity and current from noisy sensors. `tanh(velocity)` lifts the Coulomb friction
exactly.
"""

import numpy as np

from ..core import Array, frozen
from ..data import Channel, Role
from .batch import POSITION, VELOCITY, Batch, UnitTruth

CHANNELS = (POSITION, VELOCITY, Channel("current", Role.STATE, "A"), Channel("voltage", Role.INPUT, "V"))


@frozen
class DcMotorTruth(UnitTruth):
    """True parameters of the motors."""

    resistance: Array  # shape (n_units,), ohm
    inductance: Array  # shape (n_units,), H
    torque_constant: Array  # shape (n_units,), N m/A; also the constant of the back electromotive force, V s/rad
    inertia: Array  # shape (n_units,), kg m^2
    viscous: Array  # shape (n_units,), N m s/rad
    coulomb: Array  # shape (n_units,), N m

    plant, n_states, sample_period_s = "dc-motor", 3, 0.002
    slip_rad_s = 1.0  # w_s: below it friction is viscous
    current_limit_a = 8.0

    def rates(self, x: Array, u: Array) -> Array:
        """Rates of position, velocity and current for a voltage."""
        parameters = self.resistance, self.inductance, self.torque_constant, self.inertia, self.viscous, self.coulomb
        R, L, k, J, b, c = (p[:, None] for p in parameters)
        _, w, i = x
        return np.stack([w, (k * i - b * w - c * np.tanh(w / self.slip_rad_s)) / J, (u - R * i - k * w) / L])

    def held(self, x: Array) -> Array:
        """Keep the current within what the amplifier gives."""
        x[2] = np.clip(x[2], -self.current_limit_a, self.current_limit_a)
        return x


class DcMotorPopulation(Batch):
    """Settings of a simulated batch of DC motors, see `BatchSettings`; a spread of 1 means deviations of 5 to 15 %.

    The outlier has a tired magnet and a dry bearing.

    Examples
    --------
    >>> from kros.plants import DcMotorPopulation
    >>> motors = DcMotorPopulation(n_units=3, n_episodes=2, seconds=1.0, seed=3, outlier=True).simulate()
    >>> [unit.group for unit in motors.population.units]
    ['outliers', 'population', 'population', 'population']
    """

    plant, truth = DcMotorTruth.plant, DcMotorTruth
    channels = CHANNELS
    truths = tuple(Channel(f"{c.name}_true", Role.TRUTH, c.unit, of=c.name) for c in CHANNELS[1:3])
    noise = (0.1, 0.01)  # of velocity in rad/s, of current in A
    hold = (50, 200)  # shortest and longest level of the input, in samples
    voltage = 12.0
    parameters = {  # noqa: RUF012
        "resistance": (1.0, 0.05),
        "inductance": (5e-3, 0.08),
        "torque_constant": (0.05, 0.05),
        "inertia": (1e-4, 0.05),
        "viscous": (1e-4, 0.15),
        "coulomb": (1e-2, 0.15),
    }
    outlier_log_factors = {"torque_constant": -0.25, "viscous": 0.8, "coulomb": 1.0}  # noqa: RUF012

    def reference(self, rng: np.random.Generator, n_samples: int) -> Array:
        """Voltages of random size, each held for a random time and followed by its opposite for the same time."""
        pairs = n_samples // (2 * self.hold[0]) + 1
        lengths, levels = rng.integers(*self.hold, size=pairs), rng.uniform(-self.voltage, self.voltage, pairs)
        return np.repeat(np.stack([levels, -levels], axis=1).ravel(), np.repeat(lengths, 2))[:n_samples]
