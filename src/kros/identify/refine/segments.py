"""Stretches of training episodes, the data of the refinement: drawn once, cut into shorter pieces for shorter horizons."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from ...core.errors import DataError
from ...data.population import EpisodeKey, Population

Array = npt.NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Segments:
    """Stretches of recordings, the same number for every unit."""

    states: Array  # (n_samples, n, unit, segment)
    inputs: Array  # (n_samples, m, unit, segment)
    valid: npt.NDArray[np.bool_]  # (n_samples, unit, segment)
    history: int = 0

    @property
    def n_units(self) -> int:
        """Number of units."""
        return self.valid.shape[1]

    @property
    def horizon(self) -> int:
        """Steps of a free run."""
        return len(self.valid) - 1 - self.history

    @property
    def compared(self) -> npt.NDArray[np.bool_]:
        """Which samples a free run is compared with, shape (horizon, unit, segment)."""
        return self.valid[self.history + 1 :]

    def units(self, rows: npt.NDArray[Any]) -> Segments:
        """Return the segments of some units."""
        return Segments(
            np.ascontiguousarray(self.states[..., rows, :]),
            np.ascontiguousarray(self.inputs[..., rows, :]),
            np.ascontiguousarray(self.valid[..., rows, :]),
            self.history,
        )

    def first(self, count: int) -> Segments:
        """Return the first segments of every unit."""
        return Segments(
            np.ascontiguousarray(self.states[..., :count]),
            np.ascontiguousarray(self.inputs[..., :count]),
            np.ascontiguousarray(self.valid[..., :count]),
            self.history,
        )

    def cut(self, horizon: int) -> Segments:
        """Return pieces of `horizon` steps, as many as there are segments, spread evenly over them."""
        length = min(horizon, self.horizon) + 1
        pieces, n_segments = (len(self.valid) - self.history) // length, self.valid.shape[2]
        keep = np.unique(np.linspace(0, pieces * n_segments - 1, n_segments).round().astype(int))
        samples = np.arange(self.history + length)[:, None] + length * np.arange(pieces)  # (sample, piece)

        def fold(a: npt.NDArray[Any]) -> npt.NDArray[Any]:
            moved = np.moveaxis(a[samples], 1, -1)  # (sample, .., segment, piece)
            return np.ascontiguousarray(moved.reshape(*moved.shape[:-2], -1)[..., keep])

        return Segments(fold(self.states), fold(self.inputs), fold(self.valid), self.history)


def read_segments(
    population: Population,
    keys: Mapping[str, Sequence[EpisodeKey]],
    horizon: int,
    count: int,
    seed: int,
    history: int = 0,
) -> Segments:
    """Draw segments of every unit, those of its last episode at the end."""
    held = held_segments(count, keys)
    n, width = len(population.states), len(population.channels)
    length = history + horizon + 1
    values = np.empty((length, width, len(keys), count))
    valid = np.ones((length, len(keys), count), dtype=bool)
    for row, (unit, episodes) in enumerate(keys.items()):
        if not episodes:
            raise DataError(f"Refinement: unit {unit} has no training episode; leave the unit out or give it one.")
        rng = np.random.default_rng([seed, row])
        earlier = list(episodes[:-1]) or list(episodes)
        owners = [earlier[i % len(earlier)] for i in range(count - held)] + [episodes[-1]] * held
        for key in dict.fromkeys(owners):
            samples = population.read(key)
            if len(samples) < history + 2:
                raise DataError(
                    f"Refinement: {key} has {len(samples)} samples, and delays of up to {history} need at least {history + 2}; leave the episode "
                    "out or use shorter delays."
                )
            for column in (i for i, owner in enumerate(owners) if owner == key):
                start = int(rng.integers(0, max(1, len(samples) - length + 1)))
                piece = samples[start : start + length]
                values[: len(piece), :, row, column] = piece
                values[len(piece) :, :, row, column] = piece[-1]
                valid[len(piece) :, row, column] = False
    return Segments(np.ascontiguousarray(values[:, :n]), np.ascontiguousarray(values[:, n:]), valid, history)


def held_segments(count: int, keys: Mapping[str, Sequence[EpisodeKey]]) -> int:
    """Return how many of the segments come from the last episode: its share, at least one where there are two."""
    typical = int(np.median([len(episodes) for episodes in keys.values()])) if keys else 1
    return min(count - 1, max(1, round(count / max(1, typical)))) if count > 1 else 0
