"""Rows of the regression: the bank along training episodes, targets, and what errors of measurements do to rows."""

from __future__ import annotations

from collections.abc import Callable, Hashable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import compress
from typing import TypeVar

import numpy as np

from ...core import TINY, Array, Whole, frozen
from ...core.linalg import qr_triangle
from ...data import EpisodeBatch, EpisodeKey
from .bank import Bank
from .channels import Channels
from .settings import EstimatorSettings

T = TypeVar("T", bound=Hashable)
Read = Callable[[EpisodeKey], EpisodeBatch]
Rows = tuple[EpisodeKey, Array, Array, Array]  # rows of the bank, targets and weights


@dataclass(frozen=True)
class Group:
    """Episodes whose moments are summed: a part of those of a fold of units in a condition."""

    fold: int
    condition: str
    part: int


@frozen
class Recordings:
    """Training episodes, read one by one.

    Parameters
    ----------
    keys : tuple of EpisodeKey
    lengths : tuple of int
        Samples of every episode.
    read : callable
        Returns the `EpisodeBatch` of one key.
    size : ndarray, shape (n,)
        Sizes of the recorded states.
    ranges : tuple of ndarray, shape (n + m,)
        Least and largest values of states and inputs.
    persistence : ndarray, shape (m,)
        By which factor a change of an input in a sample is followed by the next one.
    bias : ndarray, optional
        Offsets of the measured states that their sensors may have at run time, of either sign, shape (q,).

    Examples
    --------
    >>> import kros
    >>> from kros.data import EpisodeBatch
    >>> from kros.observer import Recordings
    >>> motors = kros.plants.DcMotorPopulation(n_units=2, n_episodes=2, seconds=1.0, seed=3).simulate().population
    >>> recordings = Recordings.of(list(motors.keys()), lambda key: EpisodeBatch.read(motors, [key]))
    >>> len(recordings.keys), recordings.size.shape
    (4, (3,))
    """

    keys: tuple[EpisodeKey, ...]
    lengths: tuple[int, ...]
    read: Read
    size: Array
    ranges: tuple[Array, Array]
    persistence: Array
    bias: Array | None = None

    @classmethod
    def of(cls, keys: Sequence[EpisodeKey], read: Read, bias: Array | None = None) -> Recordings:
        """Return the episodes with their lengths and the sizes of their states; units by how far they move.

        So their names and their order do not matter.
        """
        extents, n = [], 0
        for batch in map(read, keys):
            values, n = np.concatenate([batch.states, batch.inputs], axis=-1)[:, 0], batch.states.shape[-1]
            changes = np.diff(values[:, n:], axis=0)
            correlated = (changes[1:] * changes[:-1]).sum(axis=0), (changes[:-1] ** 2).sum(axis=0)
            motion = values[:, :n].std(axis=0)
            extents.append((len(values), values.min(axis=0), values.max(axis=0), motion, *correlated))
        lengths, lows, highs, motions, products, squares = zip(*extents, strict=True)
        slowest = np.exp(-1 / np.median(lengths))
        persistence = np.clip(np.sum(products, axis=0) / np.maximum(np.sum(squares, axis=0), TINY), 0.0, slowest)
        low, high = np.min(lows, axis=0), np.max(highs, axis=0)
        size = np.maximum(np.abs(low), np.abs(high))[:n]
        size[size == 0] = 1.0
        moved = dict.fromkeys((key.unit for key in keys), 0.0)
        for key, motion in zip(keys, motions, strict=True):
            moved[key.unit] += float(np.sum(motion / size))
        order = sorted(range(len(keys)), key=lambda i: moved[keys[i].unit])
        ordered = tuple(keys[i] for i in order), tuple(lengths[i] for i in order)
        return cls(*ordered, read, size, (low, high), persistence, bias)

    @property
    def length(self) -> float:
        """Median length of an episode in samples."""
        return float(np.median(self.lengths))

    def some(self, count: int, groups: Mapping[EpisodeKey, Group] | None = None) -> Recordings:
        """Return some episodes, spread over all or over those of every group, and one of each at least."""
        members: dict[Group | None, list[EpisodeKey]] = {}
        for key in self.keys:
            members.setdefault((groups or {}).get(key), []).append(key)
        share = min(1.0, count / len(self.keys))
        kept = {key for keys in members.values() for key in spread(keys, max(1, round(share * len(keys))))}
        return self.only([key in kept for key in self.keys])

    def only(self, which: Sequence[bool]) -> Recordings:
        """Return the episodes that are flagged."""
        return replace(self, keys=tuple(compress(self.keys, which)), lengths=tuple(compress(self.lengths, which)))


def spread(items: Sequence[T], count: int) -> list[T]:
    """Return so many items, evenly spaced from the first to the last."""
    return [items[i] for i in np.linspace(0, len(items) - 1, min(count, len(items))).round().astype(int)]


SAMPLED = ("rows", "restarts", "elsewhere", "errors")


@frozen
class Sample:
    """Moments of thinned rows of a bank, as triangles R (., p): a mean over rows is the sum of squares of R's."""

    rows: Array
    restarts: Array  # what a start in the middle of an episode changes
    elsewhere: Array  # what a first sample at another place changes
    errors: Array  # what errors of measurements change, with their weights

    def of(self, columns: Whole) -> Sample:
        """Return the moments of some entries."""
        return Sample(*(getattr(self, name)[:, columns] for name in SAMPLED))


class Triangles:
    """Triangles of QR decompositions of rows (., p) that come in pieces, by their names."""

    def __init__(self, columns: int) -> None:
        self._columns, self._pieces = columns, dict[Hashable, list[Array]]()

    def add(self, name: Hashable, rows: Array) -> None:
        """Add rows; as soon as they are many, their triangle takes their place."""
        pieces = self._pieces.setdefault(name, [])
        pieces.append(rows)
        if sum(map(len, pieces)) > 3 * self._columns:
            pieces[:] = [self.of(name)]

    def of(self, name: Hashable) -> Array:
        """Return the triangle of the rows so far; many columns may be zero."""
        rows = np.vstack([np.zeros((1, self._columns)), *self._pieces.get(name, [])])
        used = rows.any(axis=0)
        part = qr_triangle(rows[:, used])
        triangle = np.zeros((len(part), self._columns))
        triangle[:, used] = part
        return triangle


@frozen
class Design:
    """A bank of channels with the recordings that it is fitted to: the rows of the regression."""

    channels: Channels
    bank: Bank
    recordings: Recordings
    settings: EstimatorSettings

    @classmethod
    def of(
        cls, channels: Channels, recordings: Recordings, settings: EstimatorSettings, poles: Sequence[complex] = ()
    ) -> Design:
        """Return the design with the bank of its channels, and of poles of the machines."""
        return cls(channels, Bank.of(channels, recordings.length, settings, poles), recordings, settings)

    def episodes(self, recordings: Recordings, rows: int) -> Iterator[tuple[EpisodeKey, EpisodeBatch, Whole, Array]]:
        """Yield every episode with the samples that are rows, and their weights."""
        for key, (at, weights) in zip(recordings.keys, self.thinned(recordings.lengths, rows), strict=True):
            yield key, recordings.read(key), at, weights

    def thinned(self, lengths: Sequence[int], rows: int) -> Iterator[tuple[Whole, Array]]:
        """Yield which samples of every episode are about so many rows, and for how many each stands.

        Each has a sample after it. At the start they are denser than later.
        """
        first = round(self.settings.start_rows * max(self.settings.start, default=0.0))
        first = min(first, min(lengths) - 1)
        early = max(1, -(-3 * len(lengths) * first // rows))
        late = max(1, -(-sum(lengths) // max(1, rows - len(lengths) * (first // early))))
        for number, length in enumerate(lengths):
            parts = np.arange(number % early, first, early), np.arange(first + number % late, length - 1, late)
            yield np.concatenate(parts), np.repeat([float(early), float(late)], [len(part) for part in parts])

    def rows(self, recordings: Recordings, rows: int) -> Iterator[Rows]:
        """Yield episode, bank rows, targets and weights of every episode.

        Targets are states at the next sample, of measured ones their distance from the reference of the channels.
        """
        measured = list(self.channels.measured)
        for key, batch, at, weights in self.episodes(recordings, rows):
            y = self.measurements(batch)
            v = self.signals(batch, y)
            targets = batch.states[at + 1, 0] / recordings.size
            reference = v[at] @ self.channels.reference.T
            reference[:, self.channels.held] = y[at][:, self.channels.held]
            targets[:, measured] -= reference / recordings.size[measured]
            yield key, self.seen(v, at), targets, weights

    def sample(self) -> Sample:
        """Return the moments of thinned rows of some episodes, and of what errors of measurements change them by."""
        settings, bias, bank = self.settings, self.recordings.bias, self.bank
        rng, triangles, weight = np.random.default_rng(settings.seed), Triangles(len(bank)), 0.0
        for _, batch, at, weights in self.episodes(self.recordings.some(settings.sample_episodes), settings.sample):
            y = self.measurements(batch)
            v = self.signals(batch, y)
            begin = (rng.random(len(at)) * (len(v) - 1 - at)).astype(int)
            signals, first = self.channels.filtered(v), self.channels.filtered(v[None, begin])[0]
            rows, root = bank.rows(signals, at), np.sqrt(weights)[:, None]
            elsewhere = np.zeros_like(rows)
            elsewhere[:, bank.first] = bank.started(first - signals[0], at)
            triangles.add("rows", root * rows)
            triangles.add("restarts", root * bank.restarted(signals, first, begin, begin + at))
            triangles.add("elsewhere", root * elsewhere)
            if bias is not None and bias.any():  # of either sign: it adds its own moment to the errors
                triangles.add("errors", root * (self.seen(self.signals(batch, y + bias), at) - rows))
            weight += weights.sum()
        return Sample(*(triangles.of(name) / np.sqrt(weight) for name in SAMPLED))

    def measurements(self, batch: EpisodeBatch) -> Array:
        """Return the measurements of an episode, (n_samples, q), as if all arrived: losses have rows of their own."""
        return batch.measurements(self.channels.measured, arrived=False)[: batch.lengths[0], 0]

    def signals(self, batch: EpisodeBatch, y: Array) -> Array:
        """Return the channels of an episode with measurements y, (n_samples, channels)."""
        own = {name: values[0] for name, values in batch.parameters.items()}
        return self.channels.signals(y, batch.inputs[: len(y), 0], own)

    def seen(self, v: Array, at: Whole) -> Array:
        """Return what the bank holds at samples of channels v, shape (len(at), len(self.bank))."""
        return self.bank.rows(self.channels.filtered(v), at)

    def sample_signals(self, some: int, length: int) -> Array:
        """Return what filters see in some episodes, cut to one length, shape (n_samples, batch, channels)."""
        recordings = self.recordings.some(some)
        shortest = min(length, *recordings.lengths)
        channels = (self.signals(batch, self.measurements(batch)) for batch in map(recordings.read, recordings.keys))
        return np.stack([self.channels.filtered(v)[:shortest] for v in channels], axis=1)

    @cached_property
    def groups(self) -> dict[EpisodeKey, Group]:
        """The group of every episode: those of one name are in one part, and a unit is in one fold."""
        keys, folds, parts = self.recordings.keys, self.settings.folds, self.settings.parts
        names, units = sorted({k.episode for k in keys}), list(dict.fromkeys(k.unit for k in keys))
        return {k: Group(units.index(k.unit) % folds, k.condition, names.index(k.episode) % parts) for k in keys}
