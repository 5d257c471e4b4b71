"""Smoothed trapezoidal velocity profiles through pseudorandom checkpoints.

The resulting velocity resembles a smoothed pseudorandom binary sequence (section IV-A): full speed forward or
backward almost all the time.
"""

from __future__ import annotations

import numpy as np

from ...core.arrays import Array, Flags
from ...core.errors import ConfigError

REFERENCE_STREAM = 0  # first word of the spawn key
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


def episode_reference(seed: int, episode: int, n_samples: int, n_rest: int, period_s: float) -> tuple[Array, Array]:
    """Return target position and velocity of an episode, each of shape (n_rest + n_samples,), in rad and rad/s."""
    rng = np.random.default_rng(np.random.SeedSequence(seed, spawn_key=(REFERENCE_STREAM, episode)))
    checkpoints = _draw_checkpoints(rng, n_samples, period_s)
    starts = _start_times(rng, checkpoints, n_samples, period_s) + n_rest
    return profile(checkpoints, starts, n_rest + n_samples, period_s)


def profile(checkpoints: Array, starts: Array, n_samples: int, period_s: float) -> tuple[Array, Array]:
    """Move from checkpoint to checkpoint, leaving each at a sample; position and velocity, (n_samples,), rad, rad/s."""
    lengths = np.abs(np.diff(checkpoints)) / (MAX_SPEED * period_s)
    knots = np.stack([starts, starts + lengths], axis=1).ravel()
    ramp = np.interp(np.arange(-_RAMPS, n_samples + 1), knots, np.repeat(checkpoints, 2)[1:-1])
    for length in (ACCELERATION_SAMPLES, JERK_SAMPLES):
        ramp = _moving_average(ramp, length)
    position = ramp[_RAMPS:]
    velocity = np.diff(ramp[_RAMPS - 1 :])
    velocity = 0.5 * (velocity[:-1] + velocity[1:]) / period_s
    return position[:-1].copy(), velocity


def _moving_average(values: Array, length: int) -> Array:
    """Causal moving average; before the start the first value is held."""
    padded = np.concatenate([np.full(length, values[0]), values])
    total = np.cumsum(padded - values[0])
    return values[0] + (total[length:] - total[:-length]) / length


def _durations(checkpoints: Array, period_s: float) -> Array:
    """Samples that each move takes."""
    return np.abs(np.diff(checkpoints, axis=-1)) / (MAX_SPEED * period_s) + _RAMPS


def _draw_checkpoints(rng: np.random.Generator, n_samples: int, period_s: float) -> Array:
    """Draw a start and checkpoints within one revolution in either direction that fit into the episode."""
    seconds = n_samples * period_s
    n_moves = max(2, round(seconds / SECONDS_PER_CHECKPOINT))
    for _ in range(_TRIES):
        drawn = _candidates(rng, n_moves, _RAMPS * MAX_SPEED * period_s)
        good = _fits(drawn, n_samples, period_s)
        if good.any():
            return drawn[np.argmax(good)]
    raise ConfigError(f"Drawing {n_moves} checkpoints for {seconds:g} s: none fit; ask for seconds >= 2.")


def _candidates(rng: np.random.Generator, n_moves: int, shortest: float) -> Array:
    """Draw sequences of checkpoints, neighbours at least `shortest` apart, shape (n_candidates, n_moves + 1)."""
    drawn = np.empty((_CANDIDATES, n_moves + 1))
    drawn[:, 0] = rng.uniform(-REVOLUTION, REVOLUTION, _CANDIDATES)
    for j in range(n_moves):
        here = drawn[:, j]
        below = np.maximum(0.0, here - shortest + REVOLUTION)
        above = np.maximum(0.0, REVOLUTION - here - shortest)
        place = rng.uniform(0.0, below + above)
        drawn[:, j + 1] = np.where(place < below, place - REVOLUTION, here + shortest + place - below)
    return drawn


def _fits(drawn: Array, n_samples: int, period_s: float) -> Flags:
    """Tell which candidates fill the episode without overrunning it and hold full speed in both directions."""
    total = _durations(drawn, period_s).sum(axis=1) + SETTLE_SAMPLES
    moves = np.diff(drawn, axis=1) / (MAX_SPEED * period_s)
    held = _RAMPS + LEAST_HOLD_SAMPLES
    both = (moves.max(axis=1) >= held) & (moves.min(axis=1) <= -held)
    return (total <= n_samples) & (total >= LEAST_IN_MOTION * n_samples) & both


def _start_times(rng: np.random.Generator, checkpoints: Array, n_samples: int, period_s: float) -> Array:
    """Spread the time that is left over as rests at the checkpoints."""
    durations = _durations(checkpoints, period_s)
    spare = n_samples - SETTLE_SAMPLES - durations.sum()
    rests = spare * rng.dirichlet(np.ones(len(durations) + 1))[:-1]
    return SETTLE_SAMPLES + np.cumsum(rests) + np.concatenate([[0.0], np.cumsum(durations[:-1])])
