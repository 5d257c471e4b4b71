"""A batch of simulated Harmonic Drive motor drives (section IV-A): settings in, recordings and truth out."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from ...core.choices import member
from ...core.errors import ConfigError
from ...data import prepare
from ...data.population import OUTLIERS, Channel, EpisodeKey, Population, Role, Unit
from ...data.steps import Offset, Trim
from ..simulated import SimulatedEpisodes, SimulatedPopulation
from .control import CURRENT_NOISE, GAINS, SAMPLE_PERIOD_S, Loop
from .parameters import GEAR_RATIO, DriveParameters, concatenate, draw_outlier, draw_parameters
from .reference import episode_reference
from .simulation import simulate
from .truth import Truth

Array = npt.NDArray[Any]

CONDITIONS = ("noload", "load")
CHANNELS = (
    Channel("position", Role.STATE, "rad", measured=True),
    Channel("velocity", Role.STATE, "rad/s"),
    Channel("current", Role.STATE, "1"),
    Channel("target_position", Role.INPUT, "rad"),
    Channel("target_velocity", Role.INPUT, "rad/s"),
)
TRUTHS = (Channel("velocity_true", Role.TRUTH, "rad/s", of="velocity"),)
REST_SAMPLES = 1000
# As a reader of raw recordings prepares them: offset found at rest, rest dropped; undoing the lag of the targets costs it the last sample.
PREPARATION = (Offset("position", "target_position", 500, 1000), Trim(start=REST_SAMPLES, tail=1))
OUTLIER_SERIAL = "000000"
FIRST_SERIAL = 1001
RECORDING_STREAM = 3  # first word of the spawn key of noise and offsets
MAX_OFFSET_RAD = 0.02  # of the measured position, at the gearbox output


@dataclass(frozen=True)
class HarmonicDrivePopulation:
    """Settings of a simulated batch of motor drives.

    Parameters
    ----------
    n_units : int
        Units of the population, the outlier not counted.
    n_episodes : int
        Episodes of each unit and condition; episode `e` follows the same reference everywhere.
    seconds : float, s
        Length of an episode after the rest; at least 2.
    seed : int
        The same seed gives the same recordings; unit `k` does not depend on `n_units`.
    spread : float
        Scales the relative deviations of the physical parameters; 1 means 5 to 15 percent.
    loop : Loop or str
        Stiff or soft velocity loop.
    outlier : bool
        Add one unit with loose fasteners, serial 000000, group "outliers".
    outlier_severity : float
        Scales how loose the fasteners are.
    conditions : tuple of str
        Among "noload" and "load".

    Raises
    ------
    ConfigError
        When a setting is out of its range.

    Examples
    --------
    >>> simulated = HarmonicDrivePopulation(n_units=2, n_episodes=2, seconds=4.0, conditions=("noload",)).simulate()
    >>> simulated.population.read(simulated.population.episodes[0]).shape
    (4000, 5)
    """

    n_units: int = 12
    n_episodes: int = 10
    seconds: float = 20.0
    seed: int = 0
    spread: float = 1.0
    loop: Loop | str = Loop.STIFF
    outlier: bool = False
    outlier_severity: float = 1.0
    conditions: tuple[str, ...] = CONDITIONS

    def __post_init__(self) -> None:
        object.__setattr__(self, "loop", member(Loop, self.loop, "Harmonic Drive population: the loop"))
        object.__setattr__(self, "conditions", tuple(self.conditions))
        if (
            not self.conditions
            or len(set(self.conditions)) < len(self.conditions)
            or not set(self.conditions) <= set(CONDITIONS)
        ):
            raise ConfigError(
                f"Harmonic Drive population: conditions {self.conditions} should be one or both of {CONDITIONS}, each once."
            )
        low = {"n_units": 1, "n_episodes": 1, "seconds": 2.0, "seed": 0, "spread": 0.0, "outlier_severity": 0.0}
        high = {
            "n_units": 998_998,
            "n_episodes": 1000,
            "seconds": 3600.0,
            "seed": 2**63,
            "spread": 5.0,
            "outlier_severity": 2.0,
        }
        for name, least in low.items():
            value = getattr(self, name)
            if not least <= value <= high[name]:
                raise ConfigError(
                    f"Harmonic Drive population: {name} = {value} is out of range; use {least} to {high[name]}."
                )

    def simulate(self) -> SimulatedPopulation[Truth]:
        """Simulate all episodes of all units.

        Returns
        -------
        SimulatedPopulation
            `population` as the reader of the raw layout yields it, offset calibrated and rest dropped; `raw` before preparation, with
            a second at rest at the start, an offset of the measured position in each episode, targets not lagged.
        """
        units, parameters = self._units()
        keys = tuple(
            EpisodeKey(u.id, c, str(e)) for u in units for c in sorted(self.conditions) for e in range(self.n_episodes)
        )
        trajectory = np.arange(len(keys))
        episode, condition = trajectory % self.n_episodes, trajectory // self.n_episodes % len(self.conditions)
        loaded = np.array([c == "load" for c in sorted(self.conditions)], float)[condition]
        targets = self._targets()
        loop = Loop(self.loop)
        rows = trajectory // (self.n_episodes * len(self.conditions))
        signals = simulate(parameters.take(rows), loaded, episode, (targets[0], targets[1]), GAINS[loop])
        self._disturb(signals.states, keys)
        inputs = [np.ascontiguousarray(targets[:, e]) for e in range(self.n_episodes)]
        recordings = SimulatedEpisodes(
            {key: (signals.states[i], inputs[episode[i]], signals.velocity[i]) for i, key in enumerate(keys)}
        )
        raw = Population(
            CHANNELS,
            SAMPLE_PERIOD_S,
            units,
            keys,
            recordings,
            {"plant": "harmonic-drive", "gear_ratio": GEAR_RATIO},
            TRUTHS,
        )
        load_rows = {key: i for i, key in enumerate(k for k in keys if k.condition == "load")}
        truth = Truth(
            tuple(u.id for u in units),
            parameters,
            loop,
            GAINS[loop],
            load_rows,
            signals.load_torque[:, REST_SAMPLES:-1],
        )
        return SimulatedPopulation(prepare(raw, PREPARATION), raw, truth)

    def _units(self) -> tuple[tuple[Unit, ...], DriveParameters]:
        units = tuple(Unit(f"{FIRST_SERIAL + k:06d}", "population") for k in range(self.n_units))
        parameters = draw_parameters(self.seed, self.n_units, self.spread)
        if not self.outlier:
            return units, parameters
        return (Unit(OUTLIER_SERIAL, OUTLIERS), *units), concatenate(
            draw_outlier(self.seed, self.spread, self.outlier_severity), parameters
        )

    def _targets(self) -> Array:
        """Target position and velocity of every episode, shape (2, n_episodes, n_samples)."""
        n_samples = round(self.seconds / SAMPLE_PERIOD_S) + 1
        pairs = [
            episode_reference(self.seed, e, n_samples, REST_SAMPLES, SAMPLE_PERIOD_S) for e in range(self.n_episodes)
        ]
        return np.stack([np.stack(pair) for pair in pairs], axis=1)

    def _disturb(self, states: Array, keys: tuple[EpisodeKey, ...]) -> None:
        """Add what the recording adds: an offset of the position in each episode, noise on the current."""
        for row, key in enumerate(keys):
            stream = (RECORDING_STREAM, int(key.unit), CONDITIONS.index(key.condition), int(key.episode))
            rng = np.random.default_rng(np.random.SeedSequence(self.seed, spawn_key=stream))
            states[row, 0] += rng.uniform(-MAX_OFFSET_RAD, MAX_OFFSET_RAD)
            states[row, 2] += CURRENT_NOISE * rng.standard_normal(states.shape[-1])
