"""The population: units, each recorded in conditions, each condition in episodes.

    Population ── units ── conditions ── episodes ── (sample, channel)

Episodes are read lazily, one at a time, through a source; the population itself holds only names and facts.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, field, replace
from enum import Enum
from functools import cache, cached_property
from typing import Any

import numpy as np

from ..core import Array, ByName, Columns, DataError, Names, Record, frozen, grouped, member
from .shown import Shown

DEFAULT_CONDITION = "default"
OUTLIERS = "outliers"  # units of this group are scored, but take no part in pooled results


class Role(str, Enum):
    """What a channel is to the model.

    Examples
    --------
    >>> from kros.data import Channel, Role
    >>> Channel("torque", Role.INPUT, "N m").role is Role("input")
    True
    """

    STATE = "state"
    INPUT = "input"
    TRUTH = "truth"  # what a state really was: for evaluation only


@dataclass(frozen=True)
class Channel:
    """One recorded signal.

    Parameters
    ----------
    name : str
    role : Role
    unit : str
        Unit of measure, for example ``rad/s``; empty where unknown.
    measured : bool
        Whether a state is available at run time; synthesis uses exactly those as ``y``.
    of : str
        For the role ``truth``: the state that it is the truth of, in the same unit of measure.

    Examples
    --------
    >>> Channel("angle", Role.STATE, "rad", measured=True).unit
    'rad'
    """

    name: str
    role: Role
    unit: str = ""
    measured: bool = False
    of: str = ""

    def __post_init__(self) -> None:
        object.__setattr__(self, "role", member(Role, self.role, f"Channel {self.name}: the role"))

    @property
    def label(self) -> str:
        """Name with unit of measure, and whether it is measured."""
        return f"{self.name} ({self.unit or '1'}{', measured' * self.measured})"


Channels = tuple[Channel, ...]


@dataclass(frozen=True)
class Unit:
    """One machine of the batch, with what is known about it.

    Examples
    --------
    >>> from kros.data import Unit
    >>> Unit("drive 7", group="outliers").group
    'outliers'
    """

    id: str
    group: str = ""


@dataclass(frozen=True)
class EpisodeKey:
    """Where an episode stands in the population.

    Examples
    --------
    >>> from kros.data import EpisodeKey
    >>> key = EpisodeKey("drive 7", "noload", "3")
    >>> key.unit, key.condition, key.episode
    ('drive 7', 'noload', '3')
    """

    unit: str
    condition: str
    episode: str

    def __str__(self) -> str:
        return f"episode {self.episode} of unit {self.unit} ({self.condition})"


Keys = tuple[EpisodeKey, ...]


@cache
def natural_key(text: str) -> tuple[tuple[int, int, str], ...]:
    """Sort key that orders ``2`` before ``10``."""
    return tuple((0, int(part), "") if part.isdecimal() else (1, 0, part) for part in re.split(r"(\d+)", text) if part)


@dataclass(frozen=True)
class Scaling:
    """From a column as recorded to a channel: ``channel[k] = factor * column[k + lag_samples]``, plus `offset`."""

    column: str | int | None  # name in the header, or number from 1; none where it differs between units
    factor: float = 1.0
    lag_samples: int = 0  # samples by which the column lagged behind the others
    offset: str = ""  # what was added in every episode, in words; empty where nothing was
    converted: float = 1.0  # the part of the factor that is in the files already, since recordings were converted


Scalings = Mapping[str, Scaling]


def scaling_of(scalings: Scalings, name: str) -> Scaling:
    """Return the scaling of a channel; one that is not declared is the column of its name, as it is."""
    return scalings.get(name, Scaling(name))


def columns_in_order(channels: Iterable[Any]) -> tuple[Any, ...]:
    """Return what has a `role` in the order of a source's columns: states, inputs, truths."""
    return tuple(sorted(channels, key=lambda c: list(Role).index(c.role)))


@frozen
class Split:
    """Training and test episodes, in natural order."""

    train: Keys
    test: Keys


@dataclass(frozen=True, eq=False, repr=False)
class Population(Shown):
    """Recordings of nominally identical machines.

    Parameters
    ----------
    columns : tuple of Channel
        Of the source: states first, inputs after them, then truths, what some states really were.
    sample_period_s : float
    units : tuple of Unit
    episodes : tuple of EpisodeKey
        In natural order of unit, condition and episode.
    source
        Reads episodes, float64, shape (n_samples, n_channels + n_truths); `read` and `from_arrays` make it.
    metadata : mapping
        Facts about the batch, for example ``{"plant": "harmonic-drive", "gear_ratio": 100}``.
    scaling : mapping of str to Scaling
        The columns that channels were read from, and how; a channel that is not named is the column of its name.

    Examples
    --------
    >>> import numpy as np
    >>> import kros
    >>> arrays = {unit: [np.ones((5, 2)), np.zeros((5, 2))] for unit in ("a", "b", "c")}
    >>> population = kros.from_arrays(arrays, states=["x"], measured=["x"], inputs=["u"], sample_period_s=0.01)
    >>> population.unit_ids, population.states, len(population.episodes)
    (('a', 'b', 'c'), ('x',), 6)
    >>> population.read(population.keys("b")[1]).shape
    (5, 2)
    """

    columns: Channels
    sample_period_s: float
    units: tuple[Unit, ...]
    episodes: Keys
    source: Any  # kros.data.prepare.PreparedSource
    metadata: ByName = field(default_factory=dict)
    scaling: Scalings = field(default_factory=dict)

    def _summary_rows(self) -> Record:
        rows = {f"{role.value}s": ", ".join(c.label for c in self.columns if c.role is role) for role in Role}
        counts = {"units": len(self.unit_ids), "episodes": len(self.episodes)}
        return {**counts, "conditions": ", ".join(self.conditions), "period": f"{self.sample_period_s:g} s", **rows}

    @cached_property
    def channels(self) -> Channels:
        """Columns of every episode, states before inputs."""
        return tuple(c for c in self.columns if c.role is not Role.TRUTH)

    @property
    def truths(self) -> Channels:
        """Columns behind them, for evaluation only, with what some states really were."""
        return self.columns[len(self.channels) :]

    @property
    def states(self) -> Names:
        """Names of the states, in column order."""
        return tuple(c.name for c in self.columns if c.role is Role.STATE)

    @property
    def inputs(self) -> Names:
        """Names of the inputs, in column order."""
        return tuple(c.name for c in self.columns if c.role is Role.INPUT)

    @property
    def measured(self) -> Names:
        """Names of the states that are available at run time."""
        return tuple(c.name for c in self.columns if c.role is Role.STATE and c.measured)

    @property
    def true_states(self) -> Columns:
        """Columns of the states that the truths are the truths of, in the order of the truths."""
        return tuple(self.states.index(t.of) for t in self.truths)

    @property
    def unit_ids(self) -> Names:
        """Identifiers of the units, in order."""
        return tuple(u.id for u in self.units)

    @cached_property
    def conditions(self) -> Names:
        """Conditions, in natural order."""
        return tuple(sorted({condition for _, condition in self._positions}, key=natural_key))

    def unit(self, unit_id: str) -> Unit:
        """Return one unit's facts."""
        if unit_id in self._units:
            return self._units[unit_id]
        known = ", ".join(self.unit_ids[:10]) + (" ..." if len(self.units) > 10 else "")
        raise DataError(f"Asked for unit {unit_id!r}; the population has {known}.")

    def keys(self, unit: str | None = None, condition: str | None = None) -> Keys:
        """Return the episodes of a unit, a condition or both."""
        if unit is not None and condition is not None:  # fleets ask for each of their units
            return tuple(self.episodes[i] for i in self._positions.get((unit, condition), ()))
        return tuple(e for e in self.episodes if unit in (None, e.unit) and condition in (None, e.condition))

    def read(self, key: EpisodeKey) -> Array:
        """Read one episode, shape (n_samples, n_channels)."""
        return self.read_with_truths(key)[0]

    def read_with_truths(self, key: EpisodeKey) -> tuple[Array, Array]:
        """Read one episode, shape (n_samples, n_channels), and what its states really were, (n_samples, n_truths)."""
        values, n = self.source(key), len(self.channels)
        return np.ascontiguousarray(values[:, :n]), values[:, n:]

    def read_parts(self, key: EpisodeKey) -> tuple[Array, Array]:
        """Read one episode as states (n_samples, n) and inputs (n_samples, m)."""
        values = self.read(key)
        n = len(self.states)
        return values[:, :n], values[:, n:]

    def select(self, units: Iterable[str] | None = None, conditions: Iterable[str] | None = None) -> Population:
        """Return the population restricted to some units or conditions; nothing is read."""
        wanted = dict.fromkeys(self.unit_ids if units is None else units)
        allowed = dict.fromkeys(self.conditions if conditions is None else conditions)
        positions = sorted(i for u in wanted for c in allowed for i in self._positions.get((u, c), ()))
        episodes = tuple(self.episodes[i] for i in positions)
        retained = tuple(unit for unit in self.units if unit.id in wanted)
        return replace(self, units=retained, episodes=episodes, source=self.source.restricted(episodes))

    def groups(self) -> Iterator[tuple[str, str, Keys]]:
        """Iterate over (unit, condition, episodes)."""
        for (unit, condition), positions in self._positions.items():
            yield unit, condition, tuple(self.episodes[i] for i in positions)

    @cached_property
    def _positions(self) -> dict[tuple[str, str], list[int]]:
        """Positions of the episodes of each unit and condition."""
        return grouped(range(len(self.episodes)), lambda i: (self.episodes[i].unit, self.episodes[i].condition))

    @cached_property
    def _units(self) -> dict[str, Unit]:
        return {unit.id: unit for unit in self.units}


def split_episodes(population: Population, test: Iterable[str] | None = None) -> dict[tuple[str, str], Split]:
    """Split the episodes of each unit and condition into training and test.

    The last ``max(1, n // 10)`` in natural order are for testing, unless `test` names the test episodes.

    Raises
    ------
    DataError
        When a unit and condition has fewer than two episodes, or is left without training or test episodes.

    Examples
    --------
    >>> import numpy as np
    >>> import kros
    >>> names = {"states": ["x"], "measured": ["x"], "inputs": ["u"]}
    >>> population = kros.from_arrays({"a": [np.ones((5, 2))] * 3}, sample_period_s=0.01, **names)
    >>> split = kros.data.split_episodes(population)["a", "default"]
    >>> len(split.train), len(split.test)
    (2, 1)
    """
    named, splits = None if test is None else set(test), {}
    for unit, condition, keys in population.groups():
        where = f"Splitting the episodes of unit {unit} ({condition})"
        ordered = sorted(keys, key=lambda k: natural_key(k.episode))
        if len(ordered) < 2:
            raise DataError(f"{where} into training and test needs at least two, found {len(ordered)}; record more.")
        names = {k.episode for k in ordered[-max(1, len(ordered) // 10) :]} if named is None else named
        train, tested = (tuple(k for k in ordered if (k.episode in names) is part) for part in (False, True))
        if not train or not tested:
            raise DataError(f"{where}: split.test leaves {len(train)} for training and {len(tested)} for testing.")
        splits[unit, condition] = Split(train, tested)
    return splits
