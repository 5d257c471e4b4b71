"""Episodes side by side: one array for all, shorter episodes held at their last sample."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import field, replace
from typing import Any

import numpy as np

from ..core import Array, DataError, Flags, Names, Record, Whole, frozen
from .population import EpisodeKey, Keys, Population
from .recording import repeated, some


@frozen
class EpisodeBatch:
    """Episodes of one population, time first.

    Parameters
    ----------
    keys : tuple of EpisodeKey
    lengths : ndarray, shape (batch,)
    states : ndarray, shape (n_samples, batch, n)
    inputs : ndarray, shape (n_samples, batch, m)
    sample_period_s : float
    parameters : dict of str to ndarray, shape (batch,)
        Lifting parameters of every episode's unit.
    shown : ndarray, shape (n_samples, batch, n), optional
        The states as a sensor shows them to an observer; as recorded by default.
    lost : ndarray of bool, shape (n_samples, batch, n), optional
        Samples that do not arrive.
    truths : ndarray, shape (n_samples, batch, n_truths)
        What states really were, where the population has it and it was asked for; None otherwise.

    Examples
    --------
    >>> import numpy as np
    >>> import kros
    >>> arrays = {unit: [np.ones((n, 2)) for n in (4, 3)] for unit in ("a", "b")}
    >>> population = kros.from_arrays(arrays, states=["x"], measured=["x"], inputs=["u"], sample_period_s=0.01)
    >>> batch = kros.data.EpisodeBatch.read(population, population.keys())
    >>> batch.states.shape, batch.lengths.tolist()
    ((4, 4, 1), [4, 3, 4, 3])
    """

    keys: Keys
    lengths: Whole
    states: Array
    inputs: Array
    sample_period_s: float
    parameters: dict[str, Array] = field(default_factory=dict)
    shown: Array | None = None
    lost: Flags | None = None
    truths: Array | None = None

    @classmethod
    def read(
        cls,
        population: Population,
        keys: Sequence[EpisodeKey],
        max_samples: int | None = None,
        parameters: Mapping[str, Mapping[str, float]] | None = None,
        truths: bool = False,
    ) -> EpisodeBatch:
        """Read episodes, each cut to at most `max_samples`, with the lifting parameters that all units have."""
        if not keys:
            raise DataError("Reading a batch of episodes: no episodes were named; check the split.")
        if twice := repeated(keys):
            raise DataError(f"Reading a batch of episodes: {some(twice)} named more than once; name each once.")
        pairs = {key: population.read_with_truths(key) for key in keys}
        batch = cls.of(population, {key: values[:max_samples] for key, (values, _) in pairs.items()}, parameters)
        if not (truths and population.truths):
            return batch
        return replace(batch, truths=_side_by_side([of[:max_samples] for _, of in pairs.values()], batch.lengths))

    @classmethod
    def of(
        cls,
        population: Population,
        episodes: Mapping[EpisodeKey, Array],
        parameters: Mapping[str, Mapping[str, float]] | None = None,
    ) -> EpisodeBatch:
        """Return episodes that were read, (n_samples, n_channels) each, or parts of them."""
        keys, lengths, n = tuple(episodes), np.array([len(e) for e in episodes.values()]), len(population.states)
        values = _side_by_side(list(episodes.values()), lengths)
        rows = [(parameters or {}).get(k.unit, {}) for k in keys]
        shared = {name: np.array([row[name] for row in rows]) for name in rows[0] if all(name in row for row in rows)}
        inputs = np.ascontiguousarray(values[..., n:])
        return cls(keys, lengths, values[..., :n], inputs, population.sample_period_s, shared)

    @property
    def units(self) -> Names:
        """The unit of every episode."""
        return tuple(k.unit for k in self.keys)

    @property
    def inside(self) -> Flags:
        """Which samples were recorded, and are not held, shape (n_samples, batch)."""
        return np.arange(len(self.states))[:, None] < self.lengths

    def measurements(self, measured: Sequence[int], arrived: bool = True) -> Array:
        """Return what the sensor shows of some states, (n_samples, batch, q), NaN where a sample has not `arrived`."""
        at = list(measured)
        y = np.ascontiguousarray((self.states if self.shown is None else self.shown)[..., at])
        return np.where(self.lost[..., at], np.nan, y) if arrived and self.lost is not None else y

    def head(self, n_samples: int) -> EpisodeBatch:
        """Return the same episodes, cut to a number of samples."""
        return replace(self, lengths=np.minimum(self.lengths, n_samples), **self._signals(np.s_[:n_samples]))

    def take(self, rows: Sequence[int]) -> EpisodeBatch:
        """Return some of the episodes."""
        rows = list(rows)
        parameters = {name: values[rows] for name, values in self.parameters.items()}
        keys = tuple(self.keys[i] for i in rows)
        signals = self._signals(np.s_[:, rows])
        return replace(self, keys=keys, lengths=self.lengths[rows], parameters=parameters, **signals)

    def _signals(self, part: Any) -> Record:
        """Return a part of every signal, by samples or by episodes."""
        signals = {name: getattr(self, name) for name in ("states", "inputs", "shown", "lost", "truths")}
        parts = {name: None if signal is None else signal[part] for name, signal in signals.items()}
        return parts | {"inputs": np.ascontiguousarray(parts["inputs"])}


def _side_by_side(episodes: Sequence[Array], lengths: Whole) -> Array:
    """Return episodes as one array, shape (n_samples, batch, n_columns), shorter ones held at their last sample."""
    values = np.empty((lengths.max(), len(episodes), episodes[0].shape[1]))
    for i, episode in enumerate(episodes):
        values[: len(episode), i] = episode
        values[len(episode) :, i] = episode[-1]
    return values
