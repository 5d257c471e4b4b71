"""A batch of driven pendulums: a small plant of another kind, whose lifting is `sin(position)`.

    d2 theta / dt2 = -a sin(theta) - b d theta / dt + g u

The input `u` is a pseudorandom staircase, held between samples. Position comes from an encoder, velocity from a noisy
sensor.
"""

import numpy as np

from ..core import Array, frozen
from ..data import Channel, Role
from .batch import POSITION, VELOCITY, Batch, UnitTruth


@frozen
class PendulumTruth(UnitTruth):
    """True parameters of the pendulums."""

    gravity: Array  # shape (n_units,), 1/s^2; square of the small-angle natural frequency
    damping: Array  # shape (n_units,), 1/s
    gain: Array  # shape (n_units,), rad/s^2 per unit of input

    plant, n_states, sample_period_s = "pendulum", 2, 0.01

    def rates(self, x: Array, u: Array) -> Array:
        """Rates of position and velocity for a torque."""
        a, b, g = (p[:, None] for p in (self.gravity, self.damping, self.gain))
        return np.stack([x[1], -a * np.sin(x[0]) - b * x[1] + g * u])


class PendulumPopulation(Batch):
    """Settings of a simulated batch of pendulums, see `BatchSettings`; a spread of 1 means deviations of 8 to 15 %.

    The outlier has a stiff joint.

    Examples
    --------
    >>> from kros.plants import PendulumPopulation
    >>> print(PendulumPopulation(n_units=2, n_episodes=1, seconds=1.0, seed=3).simulate().population.summary())
    Population
    units       2
    episodes    2
    conditions  default
    period      0.01 s
    states      position (rad, measured), velocity (rad/s)
    inputs      torque (1)
    """

    plant, truth = PendulumTruth.plant, PendulumTruth
    channels = (POSITION, VELOCITY, Channel("torque", Role.INPUT, "1"))
    noise = (0.01,)  # of velocity, rad/s
    hold = (20, 120)  # shortest and longest stair of the input, in samples
    parameters = {"gravity": (20.0, 0.08), "damping": (0.8, 0.15), "gain": (6.0, 0.08)}  # noqa: RUF012
    outlier_log_factors = {"gravity": -0.3, "damping": 1.2, "gain": -0.3}  # noqa: RUF012

    def reference(self, rng: np.random.Generator, n_samples: int) -> Array:
        """Levels in [-1, 1], each held for a random time."""
        lengths = rng.integers(*self.hold, size=n_samples // self.hold[0] + 1)
        return np.repeat(rng.uniform(-1.0, 1.0, len(lengths)), lengths)[:n_samples]
