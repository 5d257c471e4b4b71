"""A batch of driven pendulums: a small plant of another kind, whose lifting is `sin(position)`.

    d2 theta / dt2 = -a sin(theta) - b d theta / dt + g u

The input `u` is a pseudorandom staircase, held between samples. Position comes from an encoder, velocity from a noisy sensor.
"""

from __future__ import annotations

from dataclasses import dataclass, fields
from typing import Any

import numpy as np
import numpy.typing as npt

from ..core.errors import ConfigError
from ..data.population import DEFAULT_CONDITION, OUTLIERS, Channel, EpisodeKey, Population, Role, Unit
from .recordings import Recordings
from .simulated import SimulatedPopulation

Array = npt.NDArray[np.float64]

SAMPLE_PERIOD_S = 0.01
SUBSTEPS = 2
COUNT_RAD = 2 * np.pi / 4096
VELOCITY_NOISE = 0.01  # rad/s, standard deviation
HOLD_SAMPLES = (20, 120)  # shortest and longest stair of the input
NOMINAL = {"gravity": 20.0, "damping": 0.8, "gain": 6.0}
DEVIATION = {"gravity": 0.08, "damping": 0.15, "gain": 0.08}
OUTLIER_LOG_FACTORS = {"gravity": -0.3, "damping": 1.2, "gain": -0.3}
CHANNELS = (
    Channel("position", Role.STATE, "rad", measured=True),
    Channel("velocity", Role.STATE, "rad/s"),
    Channel("torque", Role.INPUT, "1"),
)
INPUT_STREAM, UNIT_STREAM, OUTLIER_STREAM, NOISE_STREAM = range(4)  # first words of spawn keys


@dataclass(frozen=True, eq=False)
class PendulumTruth:
    """True parameters of the pendulums.

    Parameters
    ----------
    unit_ids : tuple of str
        Order of the unit axis.
    gravity : ndarray, shape (n_units,), 1/s^2
        Square of the small-angle natural frequency.
    damping : ndarray, shape (n_units,), 1/s
    gain : ndarray, shape (n_units,), rad/s^2 per unit of input
    """

    unit_ids: tuple[str, ...]
    gravity: Array
    damping: Array
    gain: Array

    def acceleration(self, position: Array, velocity: Array, torque: Array) -> Array:
        """Angular acceleration of every unit in its own state, rad/s^2; the unit axis is the first of all arrays."""
        a, b, g = (x.reshape((-1,) + (1,) * (np.ndim(position) - 1)) for x in (self.gravity, self.damping, self.gain))
        return -a * np.sin(position) - b * velocity + g * torque

    def as_dict(self) -> dict[str, Any]:
        """Return all parameters, ready for JSON: one entry per unit."""
        names = [f.name for f in fields(self) if f.name != "unit_ids"]
        return {"plant": "pendulum", "units": {u: {n: float(getattr(self, n)[i]) for n in names} for i, u in enumerate(self.unit_ids)}}


@dataclass(frozen=True)
class PendulumPopulation:
    """Settings of a simulated batch of pendulums.

    Parameters
    ----------
    n_units : int
        Units of the population, the outlier not counted.
    n_episodes : int
    seconds : float, s
        Length of an episode.
    seed : int
        The same seed gives the same recordings; unit `k` does not depend on `n_units`.
    spread : float
        Scales the relative deviations of the parameters; 1 means 8 to 15 percent.
    outlier : bool
        Add one stiff-jointed unit, serial 000, group "outliers".
    outlier_severity : float

    Raises
    ------
    ConfigError
        When a setting is out of its range.
    """

    n_units: int = 8
    n_episodes: int = 10
    seconds: float = 20.0
    seed: int = 0
    spread: float = 1.0
    outlier: bool = False
    outlier_severity: float = 1.0

    def __post_init__(self) -> None:
        low = {"n_units": 1, "n_episodes": 1, "seconds": 1.0, "seed": 0, "spread": 0.0, "outlier_severity": 0.0}
        for name, least in low.items():
            if not getattr(self, name) >= least:
                raise ConfigError(f"Pendulum population: {name} = {getattr(self, name)} is out of range; use at least {least}.")

    def simulate(self) -> SimulatedPopulation[PendulumTruth]:
        """Simulate all episodes of all units."""
        units, truth = self._units()
        n_samples = round(self.seconds / SAMPLE_PERIOD_S)
        torque = np.stack([_staircase(self._rng(INPUT_STREAM, e), n_samples) for e in range(self.n_episodes)])
        states = _integrate(truth, torque)
        for u, unit in enumerate(units):
            for e in range(self.n_episodes):
                states[1, u, e] += VELOCITY_NOISE * self._rng(NOISE_STREAM, int(unit.id), e).standard_normal(n_samples)
        states[0] = np.rint(states[0] / COUNT_RAD) * COUNT_RAD
        keys = tuple(EpisodeKey(unit.id, DEFAULT_CONDITION, str(e)) for unit in units for e in range(self.n_episodes))
        inputs = [row[None] for row in torque]
        source = Recordings(
            {key: (states[:, i // self.n_episodes, i % self.n_episodes], inputs[i % self.n_episodes]) for i, key in enumerate(keys)}
        )
        population = Population(CHANNELS, SAMPLE_PERIOD_S, units, keys, source, {"plant": "pendulum"})
        return SimulatedPopulation(population, population, truth)

    def _units(self) -> tuple[tuple[Unit, ...], PendulumTruth]:
        units = [Unit(f"{k + 1:03d}", "population") for k in range(self.n_units)]
        drawn = [self._draw(self._rng(UNIT_STREAM, k)) for k in range(self.n_units)]
        if self.outlier:
            bad = self._draw(self._rng(OUTLIER_STREAM))
            units.insert(0, Unit("000", OUTLIERS))
            drawn.insert(0, {n: bad[n] * np.exp(self.outlier_severity * OUTLIER_LOG_FACTORS[n]) for n in NOMINAL})
        return tuple(units), PendulumTruth(tuple(u.id for u in units), **{n: np.array([d[n] for d in drawn]) for n in NOMINAL})

    def _draw(self, rng: np.random.Generator) -> dict[str, float]:
        return {n: NOMINAL[n] * float(np.exp(self.spread * DEVIATION[n] * rng.standard_normal())) for n in NOMINAL}

    def _rng(self, *stream: int) -> np.random.Generator:
        return np.random.default_rng(np.random.SeedSequence(self.seed, spawn_key=stream))


def _staircase(rng: np.random.Generator, n_samples: int) -> Array:
    """Levels in [-1, 1], each held for a random time."""
    lengths = rng.integers(*HOLD_SAMPLES, size=n_samples // HOLD_SAMPLES[0] + 1)
    return np.repeat(rng.uniform(-1.0, 1.0, len(lengths)), lengths)[:n_samples]


def _integrate(truth: PendulumTruth, torque: Array) -> Array:
    """Runge-Kutta of order four from rest at the bottom, shape (2, n_units, n_episodes, n_samples)."""
    n_episodes, n_samples = torque.shape
    out = np.empty((n_samples, 2, len(truth.unit_ids), n_episodes))
    x, h = np.zeros(out.shape[1:]), SAMPLE_PERIOD_S / SUBSTEPS
    for k in range(n_samples):
        out[k] = x
        for _ in range(SUBSTEPS):
            k1 = _derivative(truth, x, torque[:, k])
            k2 = _derivative(truth, x + 0.5 * h * k1, torque[:, k])
            k3 = _derivative(truth, x + 0.5 * h * k2, torque[:, k])
            k4 = _derivative(truth, x + h * k3, torque[:, k])
            x = x + h / 6 * (k1 + 2 * k2 + 2 * k3 + k4)
    return np.moveaxis(out, 0, -1).copy()


def _derivative(truth: PendulumTruth, x: Array, torque: Array) -> Array:
    return np.stack([x[1], truth.acceleration(x[0], x[1], torque[None, :])])
