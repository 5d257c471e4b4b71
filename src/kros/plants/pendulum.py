"""A batch of driven pendulums: a small plant of another kind, whose lifting is `sin(position)`.

    d2 theta / dt2 = -a sin(theta) - b d theta / dt + g u

The input `u` is a pseudorandom staircase, held between samples. Position comes from an encoder, velocity from a noisy
sensor.
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

SAMPLE_PERIOD_S = 0.01
VELOCITY_NOISE = 0.01  # rad/s, standard deviation
HOLD_SAMPLES = (20, 120)  # shortest and longest stair of the input
PARAMETERS = {"gravity": (20.0, 0.08), "damping": (0.8, 0.15), "gain": (6.0, 0.08)}  # nominal value, relative deviation
OUTLIER_LOG_FACTORS = {"gravity": -0.3, "damping": 1.2, "gain": -0.3}
CHANNELS = (
    Channel("position", Role.STATE, "rad", measured=True),
    Channel("velocity", Role.STATE, "rad/s"),
    Channel("torque", Role.INPUT, "1"),
)


@dataclass(frozen=True, eq=False)
class PendulumTruth(UnitTruth):
    """True parameters of the pendulums."""

    gravity: Array  # shape (n_units,), 1/s^2; square of the small-angle natural frequency
    damping: Array  # shape (n_units,), 1/s
    gain: Array  # shape (n_units,), rad/s^2 per unit of input
    plant: ClassVar[str] = "pendulum"

    def acceleration(self, position: Array, velocity: Array, torque: Array) -> Array:
        """Angular acceleration of every unit in its own state, rad/s^2; the unit axis is the first of all arrays."""
        a, b, g = (x.reshape((-1,) + (1,) * (np.ndim(position) - 1)) for x in (self.gravity, self.damping, self.gain))
        return -a * np.sin(position) - b * velocity + g * torque


class PendulumPopulation(Batch[PendulumTruth]):
    """Settings of a simulated batch of pendulums, see `BatchSettings`; a spread of 1 means deviations of 8 to 15 %.

    The outlier has a stiff joint.

    Examples
    --------
    >>> from kros.plants import PendulumPopulation
    >>> PendulumPopulation(n_units=2, n_episodes=1, seconds=1.0, seed=3).simulate().population
    Population(2 units, 1 condition, 2 episodes every 0.01 s; states position (measured), velocity; inputs torque)
    """

    plant = "pendulum"
    channels, sample_period_s, noise = CHANNELS, SAMPLE_PERIOD_S, (VELOCITY_NOISE,)
    parameters, outlier_log_factors = PARAMETERS, OUTLIER_LOG_FACTORS

    def truth(self, unit_ids: tuple[str, ...], values: Mapping[str, Array]) -> PendulumTruth:
        """Return the pendulums."""
        return PendulumTruth(unit_ids, **values)

    def reference(self, rng: np.random.Generator, n_samples: int) -> Array:
        """Levels in [-1, 1], each held for a random time."""
        lengths = rng.integers(*HOLD_SAMPLES, size=n_samples // HOLD_SAMPLES[0] + 1)
        return np.repeat(rng.uniform(-1.0, 1.0, len(lengths)), lengths)[:n_samples]

    def respond(self, truth: PendulumTruth, inputs: Array) -> Array:
        """Return position and velocity from rest at the bottom."""

        def rates(x: Array, torque: Array) -> Array:
            return np.stack([x[1], truth.acceleration(x[0], x[1], torque[None, :])])

        return runge_kutta(rates, np.zeros((2, len(truth.unit_ids), len(inputs))), inputs, self.sample_period_s)
