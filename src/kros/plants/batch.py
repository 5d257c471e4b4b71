"""What small plants with one input have in common: drawn parameters, episodes with one pseudorandom input each, sensors, and one planted outlier."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import ClassVar, Generic

import numpy as np
import numpy.typing as npt

from ..core.errors import ConfigError
from ..data.population import DEFAULT_CONDITION, OUTLIERS, Channel, EpisodeKey, Population, Unit
from .simulated import SimulatedEpisodes, SimulatedPopulation, T

Array = npt.NDArray[np.float64]

SUBSTEPS = 2
COUNT_RAD = 2 * np.pi / 4096  # of the encoder
INPUT_STREAM, UNIT_STREAM, OUTLIER_STREAM, NOISE_STREAM = range(4)  # first words of spawn keys
_LEAST = {"n_units": 1, "n_episodes": 1, "seconds": 1.0, "seed": 0, "spread": 0.0, "outlier_severity": 0.0}


@dataclass(frozen=True)
class Batch(ABC, Generic[T]):
    """Settings of a simulated batch."""

    n_units: int = 8  # Units of the population, the outlier not counted
    n_episodes: int = 10
    seconds: float = 20.0  # s; Length of an episode
    seed: int = 0  # The same seed gives the same recordings; unit `k` does not depend on `n_units`
    spread: float = 1.0  # Scales the relative deviations of the parameters
    outlier: bool = False  # Add one unit that is badly made, serial 000, group "outliers"
    outlier_severity: float = 1.0

    plant: ClassVar[str]
    channels: ClassVar[tuple[Channel, ...]]
    truths: ClassVar[tuple[Channel, ...]] = ()
    sample_period_s: ClassVar[float]
    noise: ClassVar[tuple[float, ...]]  # standard deviations of the sensors behind the encoder
    nominal: ClassVar[Mapping[str, float]]
    deviation: ClassVar[Mapping[str, float]]  # of the logarithms
    outlier_log_factors: ClassVar[Mapping[str, float]]

    def __post_init__(self) -> None:
        for name, least in _LEAST.items():
            if not getattr(self, name) >= least:
                raise ConfigError(
                    f"Simulated {self.plant}: {name} = {getattr(self, name)} is out of range; use at least {least}."
                )

    @abstractmethod
    def truth(self, unit_ids: tuple[str, ...], values: Mapping[str, Array]) -> T:
        """Return the plant of some units, from parameters of shape (n_units,)."""

    @abstractmethod
    def reference(self, rng: np.random.Generator, n_samples: int) -> Array:
        """Draw the input of an episode, shape (n_samples,)."""

    @abstractmethod
    def respond(self, truth: T, inputs: Array) -> Array:
        """Return states from rest, shape (n_states, n_units, n_episodes, n_samples), for inputs of shape (n_episodes, n_samples)."""

    def simulate(self) -> SimulatedPopulation[T]:
        """Simulate all episodes of all units."""
        units, truth = self._units()
        n_samples = round(self.seconds / self.sample_period_s)
        inputs = np.stack([self.reference(self._rng(INPUT_STREAM, e), n_samples) for e in range(self.n_episodes)])
        states = self.respond(truth, inputs)
        names = [c.name for c in self.channels]
        true = states[[names.index(t.of) for t in self.truths]]
        for u, unit in enumerate(units):
            for e in range(self.n_episodes):
                noise = self._rng(NOISE_STREAM, int(unit.id), e).standard_normal((len(self.noise), n_samples))
                states[1 : 1 + len(noise), u, e] += np.array(self.noise)[:, None] * noise
        states[0] = np.rint(states[0] / COUNT_RAD) * COUNT_RAD
        keys = tuple(EpisodeKey(unit.id, DEFAULT_CONDITION, str(e)) for unit in units for e in range(self.n_episodes))
        source = SimulatedEpisodes(
            {
                key: (states[:, u, e], inputs[e, None], true[:, u, e])
                for key, (u, e) in zip(keys, np.ndindex(len(units), self.n_episodes), strict=True)
            }
        )
        population = Population(
            self.channels, self.sample_period_s, units, keys, source, {"plant": self.plant}, self.truths
        )
        return SimulatedPopulation(population, population, truth)

    def _units(self) -> tuple[tuple[Unit, ...], T]:
        units = [Unit(f"{k + 1:03d}", "population") for k in range(self.n_units)]
        drawn = [self._draw(self._rng(UNIT_STREAM, k)) for k in range(self.n_units)]
        if self.outlier:
            bad = self._draw(self._rng(OUTLIER_STREAM))
            units.insert(0, Unit("000", OUTLIERS))
            drawn.insert(
                0, {n: v * np.exp(self.outlier_severity * self.outlier_log_factors.get(n, 0.0)) for n, v in bad.items()}
            )
        return tuple(units), self.truth(
            tuple(u.id for u in units), {n: np.array([d[n] for d in drawn]) for n in self.nominal}
        )

    def _draw(self, rng: np.random.Generator) -> dict[str, float]:
        return {
            n: v * float(np.exp(self.spread * self.deviation[n] * rng.standard_normal()))
            for n, v in self.nominal.items()
        }

    def _rng(self, *stream: int) -> np.random.Generator:
        return np.random.default_rng(np.random.SeedSequence(self.seed, spawn_key=stream))


def runge_kutta(
    rates: Callable[[Array, Array], Array],
    start: Array,
    inputs: Array,
    period_s: float,
    held: Callable[[Array], Array] = lambda x: x,
) -> Array:
    """Integrate by the method of order four, inputs held between samples, shape (n_states, n_units, n_episodes, n_samples)."""
    out = np.empty((inputs.shape[1], *start.shape))
    x, h = start, period_s / SUBSTEPS
    for k in range(len(out)):
        out[k] = x
        for _ in range(SUBSTEPS):
            k1 = rates(x, inputs[:, k])
            k2 = rates(x + 0.5 * h * k1, inputs[:, k])
            k3 = rates(x + 0.5 * h * k2, inputs[:, k])
            k4 = rates(x + h * k3, inputs[:, k])
            x = held(x + h / 6 * (k1 + 2 * k2 + 2 * k3 + k4))
    return np.moveaxis(out, 0, -1).copy()
