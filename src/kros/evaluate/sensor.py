"""Recordings as the declared sensor shows them, for training, tuning and held-out episodes.

Random draws belong to an episode, by its key: they are the same in whatever batch it is, however short it is cut, and
in whatever units.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from zlib import crc32

import numpy as np
import numpy.typing as npt

from ..data import EpisodeBatch
from ..data.population import EpisodeKey
from ..observer.sensor import Sensor, Sensors

Array = npt.NDArray[np.float64]


def as_shown(batch: EpisodeBatch, sensor: Sensors, states: Sequence[str], seed: int = 0) -> EpisodeBatch:
    """Return episodes with what the declared sensors show of their states; where nothing is declared, as they are."""
    told = {list(states).index(name): own for name, own in sensor.items() if own != Sensor()}
    if not told:
        return batch
    shown, lost = batch.states.copy(), np.zeros(batch.states.shape, dtype=bool)
    for j, own in told.items():
        xi, eta, chance = _draws(batch.keys, len(shown), [seed, j])
        shown[..., j] = _noisy(_late(batch.states[..., j], own.delay_samples + own.jitter_samples * xi), own, eta)
        lost[1:, :, j] = chance[1:] < own.dropout  # observers start at the first one
    return replace(batch, shown=shown, lost=lost if lost.any() else None)


def as_arriving(batch: EpisodeBatch, sensor: Sensors, states: Sequence[str]) -> EpisodeBatch:
    """Return recordings as late as declared, nothing else added; arguments as in `as_shown`."""
    return as_shown(batch, {name: Sensor(delay_samples=own.delay_samples) for name, own in sensor.items()}, states)


def _draws(keys: Sequence[EpisodeKey], n_samples: int, seed: Sequence[int]) -> tuple[Array, Array, Array]:
    """Draw moments, noise and chances of arrival, (n_samples, batch) each; longer episodes go on."""
    found = np.empty((3, n_samples, len(keys)))
    for i, key in enumerate(keys):
        own = crc32("\0".join((key.unit, key.condition, key.episode)).encode())
        streams = [np.random.default_rng([*seed, own, what]) for what in range(3)]
        found[0, :, i], found[1, :, i] = (rng.standard_normal(n_samples) for rng in streams[:2])
        found[2, :, i] = streams[2].random(n_samples)
    return found[0], found[1], found[2]


def _late(y: Array, behind: Array) -> Array:
    """Delayed values of signals, (n_samples, batch), on a line between samples."""
    at = np.clip(np.arange(len(y))[:, None] - behind, 0, len(y) - 1)
    low = np.floor(at).astype(int)
    share = at - low
    value = np.take_along_axis(y, low, axis=0)
    return np.where(
        share > 0, value + share * (np.take_along_axis(y, np.minimum(low + 1, len(y) - 1), axis=0) - value), value
    )


def _noisy(y: Array, own: Sensor, eta: Array) -> Array:
    y = y + own.bias + own.noise * eta
    return np.rint(y / own.resolution) * own.resolution if own.resolution else y
