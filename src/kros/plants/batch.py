"""What simulated populations have in common: recordings with their truth, drawn parameters, an outlier, sensors."""

from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, fields
from typing import Any, ClassVar

import numpy as np

from ..core import Array, ConfigError, Names, Record, frozen
from ..data import DEFAULT_CONDITION, OUTLIERS, Channel, EpisodeKey, Population, Role, Unit
from ..data.population import Channels
from ..data.prepare import assemble
from ..data.recording import Recording, Recordings

POSITION, VELOCITY = Channel("position", Role.STATE, "rad", measured=True), Channel("velocity", Role.STATE, "rad/s")
COUNT_RAD = 2 * np.pi / 4096  # of the encoder
INPUT_STREAM, UNIT_STREAM, OUTLIER_STREAM, NOISE_STREAM = range(4)  # first words of spawn keys
_LIMITS: dict[str, tuple[float, float]] = {
    "n_units": (1, 998_998),
    "n_episodes": (1, 1000),
    "seed": (0, 2**63),
    "spread": (0, 5),
    "outlier_severity": (0, 2),
}


@frozen
class SimulatedPopulation:
    """Recordings and what is true about them.

    Examples
    --------
    >>> from kros.plants import DcMotorPopulation
    >>> simulated = DcMotorPopulation(n_units=2, n_episodes=1, seconds=1.0, seed=3).simulate()
    >>> list(simulated.truth.as_dict()["units"])
    ['001', '002']
    """

    population: Population  # ready for identification, as a reader yields it
    raw: Population  # as recorded, before preparation; the same where a plant needs none
    truth: Any  # true parameters, with ``as_dict()``, ready for JSON


class SimulatedEpisodes(Recordings):
    """Raw episodes in memory, (n, n_samples) a part: states, inputs, what states really were."""

    def read(self, key: EpisodeKey) -> Recording:
        """Return an episode."""
        return Recording(key, np.ascontiguousarray(np.concatenate(self.places[key]).T))


@dataclass(frozen=True)
class BatchSettings:
    """Settings of every simulated batch."""

    n_units: int = 8  # units of the population, the outlier not counted
    n_episodes: int = 10
    seconds: float = 20.0  # s; length of an episode
    seed: int = 0  # the same seed gives the same recordings; unit `k` does not depend on `n_units`
    spread: float = 1.0  # scales the relative deviations of the parameters
    outlier: bool = False  # add one unit that is badly made, serial of zeros, group "outliers"
    outlier_severity: float = 1.0

    plant: ClassVar[str]
    least_seconds = 1.0
    serial = (1, 3)  # of the first unit, and its digits
    outlier_stream: ClassVar[tuple[int, ...]] = (OUTLIER_STREAM,)
    parameters: ClassVar[Mapping[str, tuple[float, float]]]  # nominal value, deviation of its logarithm at spread 1
    outlier_log_factors: ClassVar[Mapping[str, float]]  # on each parameter at severity s: exp(s value)

    def __post_init__(self) -> None:
        for name, (low, high) in (_LIMITS | {"seconds": (self.least_seconds, 3600)}).items():
            value = getattr(self, name)
            if not low <= value <= high:
                raise ConfigError(f"Simulated {self.plant}: {name} = {value} is out of range; use {low} to {high}.")

    def random(self, *stream: int) -> np.random.Generator:
        """Return the generator of one stream of random numbers."""
        return np.random.default_rng(np.random.SeedSequence(self.seed, spawn_key=stream))

    def units(self) -> tuple[tuple[Unit, ...], dict[str, Array]]:
        """Draw the units, the outlier in front of them, and their parameters by name."""
        first, digits = self.serial
        units = [Unit(f"{first + k:0{digits}d}", "population") for k in range(self.n_units)]
        drawn = [self.draw(self.random(UNIT_STREAM, k)) for k in range(self.n_units)]
        if self.outlier:
            bad, factors = self.draw(self.random(*self.outlier_stream)), self.outlier_log_factors
            units.insert(0, Unit(digits * "0", OUTLIERS))
            drawn.insert(0, {n: v * np.exp(self.outlier_severity * factors.get(n, 0.0)) for n, v in bad.items()})
        return tuple(units), {n: np.array([d[n] for d in drawn]) for n in drawn[0]}

    def draw(self, rng: np.random.Generator) -> Record:
        """Draw the parameters of one unit."""
        kinds = self.parameters.items()
        return {n: v * float(np.exp(self.spread * dev * rng.standard_normal())) for n, (v, dev) in kinds}


@frozen
class UnitTruth(ABC):
    """True parameters, each an array of shape (n_units,), and the differential equation that they belong to."""

    unit_ids: Names  # order of the unit axis
    plant: ClassVar[str]
    n_states: ClassVar[int]
    sample_period_s: ClassVar[float]

    @abstractmethod
    def rates(self, x: Array, u: Array) -> Array:
        """Return dx/dt, shape (n_states, n_units, n_episodes), for inputs (n_episodes,)."""

    def held(self, x: Array) -> Array:
        """Return states within their limits."""
        return x

    def respond(self, inputs: Array) -> Array:
        """Return states from rest, (n_states, n_units, n_episodes, n_samples), by two Runge-Kutta steps a sample."""
        x, h = np.zeros((self.n_states, len(self.unit_ids), len(inputs))), self.sample_period_s / 2
        out = np.empty((inputs.shape[1], *x.shape))
        for k, u in enumerate(inputs.T):
            out[k] = x
            for _ in range(2):
                k1 = self.rates(x, u)
                k2 = self.rates(x + 0.5 * h * k1, u)
                k3 = self.rates(x + 0.5 * h * k2, u)
                k4 = self.rates(x + h * k3, u)
                x = self.held(x + h / 6 * (k1 + 2 * k2 + 2 * k3 + k4))
        return np.moveaxis(out, 0, -1).copy()

    def as_dict(self) -> Record:
        """Return all parameters, ready for JSON: one entry per unit."""
        return {"plant": self.plant, "units": by_unit(self.unit_ids, self)}


def by_unit(units: Sequence[str], parameters: Any) -> dict[str, Record]:
    """Return the fields of parameters, whose first axis is that of units, ready for JSON: one entry per unit."""
    names = [f.name for f in fields(parameters) if f.name != "unit_ids"]
    return {unit: {name: getattr(parameters, name)[i].tolist() for name in names} for i, unit in enumerate(units)}


class Batch(BatchSettings, ABC):
    """A batch of small plants with one pseudorandom input; the first state is seen by an encoder."""

    truth: Callable[..., UnitTruth]  # of the units: names, then arrays by name
    channels: ClassVar[Channels]
    truths: ClassVar[Channels] = ()
    noise: ClassVar[tuple[float, ...]]  # standard deviations of the sensors behind the encoder

    @abstractmethod
    def reference(self, rng: np.random.Generator, n_samples: int) -> Array:
        """Draw the input of an episode, shape (n_samples,)."""

    def simulate(self) -> SimulatedPopulation:
        """Simulate all episodes of all units."""
        units, values = self.units()
        truth = self.truth(tuple(u.id for u in units), **values)
        n_samples = round(self.seconds / truth.sample_period_s)
        inputs = np.stack([self.reference(self.random(INPUT_STREAM, e), n_samples) for e in range(self.n_episodes)])
        states, names = truth.respond(inputs), [c.name for c in self.channels]
        true = states[[names.index(t.of) for t in self.truths]]
        states[0] = np.rint(states[0] / COUNT_RAD) * COUNT_RAD
        parts = {}
        for u, e in np.ndindex(len(units), self.n_episodes):
            noise = self.random(NOISE_STREAM, int(units[u].id), e).standard_normal((len(self.noise), n_samples))
            states[1 : 1 + len(noise), u, e] += np.array(self.noise)[:, None] * noise
            key = EpisodeKey(units[u].id, DEFAULT_CONDITION, str(e))
            parts[key] = states[:, u, e], inputs[e, None], true[:, u, e]
        columns, about = (*self.channels, *self.truths), {"plant": truth.plant}
        population = assemble(SimulatedEpisodes(parts), columns, units, truth.sample_period_s, about)
        return SimulatedPopulation(population, population, truth)
