"""A batch of simulated Harmonic Drive motor drives (section IV-A): settings in, recordings and truth out.

Smoothed trapezoidal velocity profiles through pseudorandom checkpoints.

The resulting velocity resembles a smoothed pseudorandom binary sequence (section IV-A): full speed forward or
backward almost all the time.
"""

from collections.abc import Mapping
from dataclasses import asdict, dataclass

import numpy as np

from ...core import AnyArray, Array, ConfigError, Flags, Names, Record, frozen
from ...data import Channel, EpisodeKey, Role, prepare
from ...data.prepare import assemble
from ...data.steps import Offset, Trim
from ..batch import (
    INPUT_STREAM,
    NOISE_STREAM,
    OUTLIER_STREAM,
    POSITION,
    VELOCITY,
    BatchSettings,
    SimulatedEpisodes,
    SimulatedPopulation,
    by_unit,
)
from .dynamics import (
    CURRENT_NOISE,
    GAINS,
    GEAR_RATIO,
    NOMINAL,
    OUTLIER_LOG_FACTORS,
    RIPPLE,
    RIPPLE_DEVIATION,
    SAMPLE_PERIOD_S,
    DriveParameters,
    Gains,
    simulate,
)

MAX_SPEED = np.pi  # rad/s: 0.5 rev/s at the output
ACCELERATION_SAMPLES = 150  # length of the ramps of the trapezoid
JERK_SAMPLES = 60  # length of the ramps of the acceleration
SETTLE_SAMPLES = 20  # shortest rest before the first move
SECONDS_PER_CHECKPOINT = 2.0
LEAST_IN_MOTION = 0.75  # share of the episode
LEAST_HOLD_SAMPLES = 350  # at full speed, at least once in each direction
REVOLUTION = 2 * np.pi
_RAMPS = ACCELERATION_SAMPLES + JERK_SAMPLES  # length of a move at full speed: shorter ones would not reach it
_CANDIDATES = 64
_TRIES = 1000


def episode_reference(rng: np.random.Generator, n_samples: int, n_rest: int) -> tuple[Array, Array]:
    """Return target position and velocity of an episode, each of shape (n_rest + n_samples,), in rad and rad/s."""
    checkpoints = _draw_checkpoints(rng, n_samples)
    durations = _lengths(checkpoints) + _RAMPS
    spare = n_samples - SETTLE_SAMPLES - durations.sum()  # spread as rests at the checkpoints
    rests = spare * rng.dirichlet(np.ones(len(durations) + 1))[:-1]
    starts = SETTLE_SAMPLES + np.cumsum(rests) + np.concatenate([[0.0], np.cumsum(durations[:-1])]) + n_rest
    return profile(checkpoints, starts, n_rest + n_samples)


def profile(checkpoints: Array, starts: Array, n_samples: int) -> tuple[Array, Array]:
    """Move from checkpoint to checkpoint, leaving each at a sample; position and velocity, (n_samples,), rad, rad/s."""
    knots = np.stack([starts, starts + _lengths(checkpoints)], axis=1).ravel()
    ramp = np.interp(np.arange(-_RAMPS, n_samples + 1), knots, np.repeat(checkpoints, 2)[1:-1])
    for length in (ACCELERATION_SAMPLES, JERK_SAMPLES):
        total = np.cumsum(np.concatenate([np.zeros(length), ramp - ramp[0]]))  # before the start its value is held
        ramp = ramp[0] + (total[length:] - total[:-length]) / length
    position = ramp[_RAMPS:]
    velocity = np.diff(ramp[_RAMPS - 1 :])
    velocity = 0.5 * (velocity[:-1] + velocity[1:]) / SAMPLE_PERIOD_S
    return position[:-1].copy(), velocity


def _lengths(checkpoints: Array) -> Array:
    """Samples that each move takes at full speed."""
    return np.abs(np.diff(checkpoints)) / (MAX_SPEED * SAMPLE_PERIOD_S)


def _draw_checkpoints(rng: np.random.Generator, n_samples: int) -> Array:
    """Draw a start and checkpoints within one revolution in either direction that fit into the episode."""
    seconds = n_samples * SAMPLE_PERIOD_S
    n_moves = max(2, round(seconds / SECONDS_PER_CHECKPOINT))
    for _ in range(_TRIES):
        drawn = _candidates(rng, n_moves)
        good = _fits(drawn, n_samples)
        if good.any():
            return drawn[np.argmax(good)]
    raise ConfigError(f"Drawing {n_moves} checkpoints for {seconds:g} s: none fit; ask for seconds >= 2.")


def _candidates(rng: np.random.Generator, n_moves: int) -> Array:
    """Draw checkpoints, so far apart that full speed is reached, shape (n_candidates, n_moves + 1)."""
    drawn, shortest = np.empty((_CANDIDATES, n_moves + 1)), _RAMPS * MAX_SPEED * SAMPLE_PERIOD_S
    drawn[:, 0] = rng.uniform(-REVOLUTION, REVOLUTION, _CANDIDATES)
    for j in range(n_moves):
        here = drawn[:, j]
        below = np.maximum(0.0, here - shortest + REVOLUTION)
        above = np.maximum(0.0, REVOLUTION - here - shortest)
        place = rng.uniform(0.0, below + above)
        drawn[:, j + 1] = np.where(place < below, place - REVOLUTION, here + shortest + place - below)
    return drawn


def _fits(drawn: Array, n_samples: int) -> Flags:
    """Tell which candidates fill the episode without overrunning it and hold full speed in both directions."""
    lengths, forward = _lengths(drawn), np.diff(drawn) > 0
    held = lengths >= _RAMPS + LEAST_HOLD_SAMPLES
    total = (lengths + _RAMPS).sum(axis=1) + SETTLE_SAMPLES
    both = np.any(held & forward, axis=1) & np.any(held & ~forward, axis=1)
    return (total <= n_samples) & (total >= LEAST_IN_MOTION * n_samples) & both


CONDITIONS = ("noload", "load")
CHANNELS = (
    POSITION,
    VELOCITY,
    Channel("current", Role.STATE, "1"),
    Channel("target_position", Role.INPUT, "rad"),
    Channel("target_velocity", Role.INPUT, "rad/s"),
)
TRUTHS = (Channel("velocity_true", Role.TRUTH, "rad/s", of="velocity"),)
REST_SAMPLES = 1000
# As a reader of raw recordings prepares them; undoing the lag of the targets costs it the last sample.
PREPARATION = (Offset("position", "target_position", 500, 1000), Trim(start=REST_SAMPLES, tail=1))
MAX_OFFSET_RAD = 0.02  # of the measured position, at the gearbox output


@frozen
class Truth:
    """True parameters and signals of a simulated population."""

    unit_ids: Names  # order of the unit axis
    parameters: DriveParameters
    loop: str
    gains: Gains
    load_torque: Mapping[EpisodeKey, AnyArray]  # that the load takes from the flange, inertia and gravity, (n_samples,)

    @property
    def phase_rad(self) -> AnyArray:
        """Phase `phi1` of (34), shape (n_units,), rad, in [0, 2 pi)."""
        return self.parameters.phase_rad[:, 0]

    def as_dict(self) -> Record:
        """Return everything but the long signals, ready for JSON: one entry per unit."""
        units = by_unit(self.unit_ids, self.parameters)
        return {"plant": "harmonic-drive", "loop": self.loop, "gains": asdict(self.gains), "units": units}


@dataclass(frozen=True)
class HarmonicDrivePopulation(BatchSettings):
    """Settings of a simulated batch of motor drives: those of `BatchSettings`, the loop and the conditions.

    Episode `e` follows the same reference everywhere; the outlier has loose fasteners.

    Examples
    --------
    >>> simulated = HarmonicDrivePopulation(n_units=2, n_episodes=2, seconds=4.0, conditions=("noload",)).simulate()
    >>> simulated.population.read(simulated.population.episodes[0]).shape
    (4000, 5)
    """

    n_units: int = 12
    loop: str = "stiff"  # stiff or soft velocity loop
    conditions: Names = CONDITIONS  # among "noload" and "load"

    plant, least_seconds = "harmonic-drive", 2.0
    serial, outlier_stream = (1001, 6), (OUTLIER_STREAM, 0)
    parameters, outlier_log_factors = NOMINAL, OUTLIER_LOG_FACTORS

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.loop not in GAINS:
            raise ConfigError(f"Harmonic Drive population: loop {self.loop!r} should be one of {', '.join(GAINS)}.")
        object.__setattr__(self, "conditions", tuple(self.conditions))
        if not self.conditions or sorted(self.conditions) != sorted({*self.conditions} & {*CONDITIONS}):
            raise ConfigError(f"Harmonic Drive population: conditions {self.conditions} should be among {CONDITIONS}.")

    def simulate(self) -> SimulatedPopulation:
        """Simulate all episodes of all units, as the reader of the raw layout yields them and, `raw`, as recorded.

        Raw episodes have a second at rest at the start and an offset of the measured position.
        """
        (units, values), conditions = self.units(), sorted(self.conditions)
        parameters = DriveParameters(**values)
        keys = tuple(EpisodeKey(u.id, c, str(e)) for u in units for c in conditions for e in range(self.n_episodes))
        row, condition, episode = np.unravel_index(np.arange(len(keys)), (len(units), len(conditions), self.n_episodes))
        loaded = np.array([c == "load" for c in conditions], float)[condition]
        samples, gains = round(self.seconds / SAMPLE_PERIOD_S) + 1, GAINS[self.loop]
        streams = (self.random(INPUT_STREAM, e) for e in range(self.n_episodes))
        inputs = [np.stack(episode_reference(rng, samples, REST_SAMPLES)) for rng in streams]
        position, velocity = np.stack(inputs, axis=1)
        states, true, torque = simulate(parameters.take(row), loaded, episode, (position, velocity), gains)
        parts = {}
        for i, key in enumerate(keys):  # what the recording adds: an offset of the position, noise on the current
            rng = self.random(NOISE_STREAM, int(key.unit), CONDITIONS.index(key.condition), int(key.episode))
            states[i, 0] += rng.uniform(-MAX_OFFSET_RAD, MAX_OFFSET_RAD)
            states[i, 2] += CURRENT_NOISE * rng.standard_normal(states.shape[-1])
            parts[key] = states[i], inputs[episode[i]], true[i]
        about = {"plant": self.plant, "gear_ratio": GEAR_RATIO}
        raw = assemble(SimulatedEpisodes(parts), (*CHANNELS, *TRUTHS), units, SAMPLE_PERIOD_S, about)
        load_torque = dict(zip((k for k in keys if k.condition == "load"), torque[:, REST_SAMPLES:-1], strict=True))
        truth = Truth(tuple(u.id for u in units), parameters, self.loop, gains, load_torque)
        return SimulatedPopulation(prepare(raw, PREPARATION), raw, truth)

    def draw(self, rng: np.random.Generator) -> Record:
        """Draw the parameters of one drive, those of its ripple last."""
        drawn = super().draw(rng)
        drawn["ripple"] = RIPPLE * np.exp(self.spread * RIPPLE_DEVIATION * rng.standard_normal(len(RIPPLE)))
        drawn["phase_rad"] = rng.uniform(0.0, 2 * np.pi, len(RIPPLE))
        return drawn
