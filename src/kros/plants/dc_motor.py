"""A batch of brushed DC motors behind amplifiers with a current limit: three states whose ranges differ a thousandfold.

    L di/dt = v - R i - k w,   |i| <= limit
    J dw/dt = k i - b w - c tanh(w / w_s)
      dp/dt = w

The input `v` is a pseudorandom voltage; every level is followed by its opposite, so that the shaft comes back. Position comes from an encoder,
velocity and current from noisy sensors. `tanh(velocity)` lifts the Coulomb friction exactly.
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

SAMPLE_PERIOD_S = 0.002
SUBSTEPS = 2
COUNT_RAD = 2 * np.pi / 4096
VELOCITY_NOISE = 0.1  # rad/s, standard deviation
CURRENT_NOISE = 0.01  # A, standard deviation
CURRENT_LIMIT_A = 8.0
SLIP_RAD_S = 1.0  # w_s: below it friction is viscous
HOLD_SAMPLES = (50, 200)  # shortest and longest level of the input
VOLTAGE_V = 12.0
NOMINAL = {"resistance": 1.0, "inductance": 5e-3, "torque_constant": 0.05, "inertia": 1e-4, "viscous": 1e-4, "coulomb": 1e-2}
DEVIATION = {"resistance": 0.05, "inductance": 0.08, "torque_constant": 0.05, "inertia": 0.05, "viscous": 0.15, "coulomb": 0.15}
OUTLIER_LOG_FACTORS = {"torque_constant": -0.25, "viscous": 0.8, "coulomb": 1.0}  # a tired magnet and a dry bearing
CHANNELS = (
    Channel("position", Role.STATE, "rad", measured=True),
    Channel("velocity", Role.STATE, "rad/s"),
    Channel("current", Role.STATE, "A"),
    Channel("voltage", Role.INPUT, "V"),
)
INPUT_STREAM, UNIT_STREAM, OUTLIER_STREAM, NOISE_STREAM = range(4)  # first words of spawn keys


@dataclass(frozen=True, eq=False)
class DcMotorTruth:
    """True parameters of the motors.

    Parameters
    ----------
    unit_ids : tuple of str
        Order of the unit axis.
    resistance : ndarray, shape (n_units,), ohm
    inductance : ndarray, shape (n_units,), H
    torque_constant : ndarray, shape (n_units,), N m/A
        Also the constant of the back electromotive force, V s/rad.
    inertia : ndarray, shape (n_units,), kg m^2
    viscous : ndarray, shape (n_units,), N m s/rad
    coulomb : ndarray, shape (n_units,), N m
    """

    unit_ids: tuple[str, ...]
    resistance: Array
    inductance: Array
    torque_constant: Array
    inertia: Array
    viscous: Array
    coulomb: Array

    def respond(self, voltage: Array) -> Array:
        """Simulate all motors from rest, without sensors; voltage held between samples.

        Parameters
        ----------
        voltage : ndarray, shape (n_episodes, n_samples), V

        Returns
        -------
        ndarray, shape (3, n_units, n_episodes, n_samples)
            Position, velocity and current, by Runge-Kutta of order four.
        """
        n_episodes, n_samples = voltage.shape
        out = np.empty((n_samples, 3, len(self.unit_ids), n_episodes))
        x, h = np.zeros(out.shape[1:]), SAMPLE_PERIOD_S / SUBSTEPS
        for k in range(n_samples):
            out[k] = x
            for _ in range(SUBSTEPS):
                k1 = self._rates(x, voltage[:, k])
                k2 = self._rates(x + 0.5 * h * k1, voltage[:, k])
                k3 = self._rates(x + 0.5 * h * k2, voltage[:, k])
                k4 = self._rates(x + h * k3, voltage[:, k])
                x = x + h / 6 * (k1 + 2 * k2 + 2 * k3 + k4)
                x[2] = np.clip(x[2], -CURRENT_LIMIT_A, CURRENT_LIMIT_A)
        return np.moveaxis(out, 0, -1).copy()

    def steady_velocity(self, voltage: float) -> Array:
        """Velocity at which a constant positive voltage turns the motors, far above `SLIP_RAD_S`; rad/s, shape (n_units,)."""
        k, R = self.torque_constant, self.resistance
        return (k * voltage - R * self.coulomb) / (k**2 + R * self.viscous)

    def as_dict(self) -> dict[str, Any]:
        """Return all parameters, ready for JSON: one entry per unit."""
        names = [f.name for f in fields(self) if f.name != "unit_ids"]
        return {"plant": "dc-motor", "units": {u: {n: float(getattr(self, n)[i]) for n in names} for i, u in enumerate(self.unit_ids)}}

    def _rates(self, x: Array, voltage: Array) -> Array:
        R, L, k, J, b, c = (
            p[:, None] for p in (self.resistance, self.inductance, self.torque_constant, self.inertia, self.viscous, self.coulomb)
        )
        _, w, i = x
        return np.stack([w, (k * i - b * w - c * np.tanh(w / SLIP_RAD_S)) / J, (voltage - R * i - k * w) / L])


@dataclass(frozen=True)
class DcMotorPopulation:
    """Settings of a simulated batch of DC motors.

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
        Scales the relative deviations of the parameters; 1 means 5 to 15 percent.
    outlier : bool
        Add one unit with a tired magnet and a dry bearing, serial 000, group "outliers".
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
                raise ConfigError(f"DC motor population: {name} = {getattr(self, name)} is out of range; use at least {least}.")

    def simulate(self) -> SimulatedPopulation[DcMotorTruth]:
        """Simulate all episodes of all units."""
        units, truth = self._units()
        n_samples = round(self.seconds / SAMPLE_PERIOD_S)
        voltage = np.stack([_there_and_back(self._rng(INPUT_STREAM, e), n_samples) for e in range(self.n_episodes)])
        states = truth.respond(voltage)
        for u, unit in enumerate(units):
            for e in range(self.n_episodes):
                noise = self._rng(NOISE_STREAM, int(unit.id), e).standard_normal((2, n_samples))
                states[1:, u, e] += np.array([[VELOCITY_NOISE], [CURRENT_NOISE]]) * noise
        states[0] = np.rint(states[0] / COUNT_RAD) * COUNT_RAD
        keys = tuple(EpisodeKey(unit.id, DEFAULT_CONDITION, str(e)) for unit in units for e in range(self.n_episodes))
        inputs = [row[None] for row in voltage]
        source = Recordings(
            {key: (states[:, i // self.n_episodes, i % self.n_episodes], inputs[i % self.n_episodes]) for i, key in enumerate(keys)}
        )
        population = Population(CHANNELS, SAMPLE_PERIOD_S, units, keys, source, {"plant": "dc-motor"})
        return SimulatedPopulation(population, population, truth)

    def _units(self) -> tuple[tuple[Unit, ...], DcMotorTruth]:
        units = [Unit(f"{k + 1:03d}", "population") for k in range(self.n_units)]
        drawn = [self._draw(self._rng(UNIT_STREAM, k)) for k in range(self.n_units)]
        if self.outlier:
            bad = self._draw(self._rng(OUTLIER_STREAM))
            units.insert(0, Unit("000", OUTLIERS))
            drawn.insert(0, {n: bad[n] * np.exp(self.outlier_severity * OUTLIER_LOG_FACTORS.get(n, 0.0)) for n in NOMINAL})
        return tuple(units), DcMotorTruth(tuple(u.id for u in units), **{n: np.array([d[n] for d in drawn]) for n in NOMINAL})

    def _draw(self, rng: np.random.Generator) -> dict[str, float]:
        return {n: NOMINAL[n] * float(np.exp(self.spread * DEVIATION[n] * rng.standard_normal())) for n in NOMINAL}

    def _rng(self, *stream: int) -> np.random.Generator:
        return np.random.default_rng(np.random.SeedSequence(self.seed, spawn_key=stream))


def _there_and_back(rng: np.random.Generator, n_samples: int) -> Array:
    """Voltages of random size, each held for a random time and followed by its opposite for the same time."""
    pairs = n_samples // (2 * HOLD_SAMPLES[0]) + 1
    lengths, levels = rng.integers(*HOLD_SAMPLES, size=pairs), rng.uniform(-VOLTAGE_V, VOLTAGE_V, pairs)
    return np.repeat(np.stack([levels, -levels], axis=1).ravel(), np.repeat(lengths, 2))[:n_samples]
