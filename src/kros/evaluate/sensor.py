"""Recordings as the declared sensor shows them, for training, tuning and held-out episodes.

Random draws belong to an episode, by its key: they are the same in whatever batch it is, however short it is cut, and
in whatever units.
"""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from zlib import crc32

import numpy as np

from ..core import Array, ArrayLike, Whole, frozen
from ..data import EpisodeBatch, EpisodeKey, Population
from ..observer import Observer, Sensor, Sensors


def as_shown(batch: EpisodeBatch, sensor: Sensors, states: Sequence[str], seed: int = 0) -> EpisodeBatch:
    """Return episodes with what the declared sensors show of their states; where nothing is declared, as they are."""
    declared = {list(states).index(name): one for name, one in sensor.items() if one != Sensor()}
    if not declared:
        return batch
    shown, lost = batch.states.copy(), np.zeros(batch.states.shape, dtype=bool)
    for j, one in declared.items():
        xi, eta, chance = _draws(batch.keys, len(shown), [seed, j])
        y = _late(batch.states[..., j], one.delay_samples + one.jitter_samples * xi) + one.bias + one.noise * eta
        shown[..., j] = np.rint(y / one.resolution) * one.resolution if one.resolution else y
        lost[1:, :, j] = chance[1:] < one.dropout  # observers start at the first one
    return replace(batch, shown=shown, lost=lost if lost.any() else None)


def as_arriving(batch: EpisodeBatch, sensor: Sensors, states: Sequence[str]) -> EpisodeBatch:
    """Return recordings as late as declared, nothing else added; arguments as in `as_shown`."""
    return as_shown(batch, {name: Sensor(delay_samples=own.delay_samples) for name, own in sensor.items()}, states)


def _draws(keys: Sequence[EpisodeKey], n_samples: int, seed: Sequence[int]) -> Array:
    """Draw moments, noise and chances of arrival, (3, n_samples, batch); longer episodes go on."""
    draws = np.empty((3, n_samples, len(keys)))
    for i, key in enumerate(keys):
        place = crc32("\0".join((key.unit, key.condition, key.episode)).encode())
        moments, noise, chances = (np.random.default_rng([*seed, place, what]) for what in range(3))
        draws[..., i] = moments.standard_normal(n_samples), noise.standard_normal(n_samples), chances.random(n_samples)
    return draws


def _late(y: Array, behind: Array) -> Array:
    """Delayed values of signals, (n_samples, batch), on a line between samples."""
    k = np.arange(len(y))
    columns = zip((k[:, None] - behind).T, y.T, strict=True)
    return np.stack([np.interp(at, k, column) for at, column in columns], axis=1)


@frozen
class Arriving:
    """Episodes as they arrive: y (n_samples, batch, q), u (n_samples, batch, m), lengths and lifting parameters."""

    y: Array
    u: Array
    lengths: Whole
    parameters: dict[str, ArrayLike]


def arriving(
    observer: Observer,
    population: Population,
    episodes: Mapping[EpisodeKey, Array],
    values: Mapping[str, Mapping[str, float]],
) -> Arriving:
    """Return episodes that were read, or parts of them, with lifting parameters by unit."""
    batch = EpisodeBatch.of(population, episodes, values)
    measured = [population.states.index(observer.lifting.states[i]) for i in observer.measured]
    y = as_arriving(batch, observer.sensor, population.states).measurements(measured)
    u = batch.inputs[..., [population.inputs.index(name) for name in observer.inputs]]
    return Arriving(y, u, batch.lengths, observer.own(batch.parameters))
