"""Lazy preparation, and how every reader makes its population: recordings, then steps, then checks."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
import numpy.typing as npt

from ..core.errors import DataError
from .checks import check_episode, check_period, check_structure
from .population import Channel, EpisodeKey, EpisodeSource, Population, Role, Unit, natural_key, restrict
from .recording import TIME_TOLERANCE, Recording, RecordingSource, check_even, estimate_period
from .steps import Resample, Step


@dataclass(frozen=True, eq=False)
class EvenRecordings:
    """Recordings of a population that is even already."""

    source: EpisodeSource

    def __call__(self, key: EpisodeKey) -> Recording:
        """Return one episode."""
        return Recording(key, self.source(key))

    def restricted(self, keys: Iterable[EpisodeKey]) -> EvenRecordings:
        """Return the same for fewer episodes."""
        return EvenRecordings(restrict(self.source, keys))


@dataclass(frozen=True, eq=False)
class PreparedSource:
    """Read a recording, check its time, apply the steps, check the result. Can be pickled when `recordings` can.

    Parameters
    ----------
    recordings : callable
        Returns a `Recording` for an `EpisodeKey`.
    channels : tuple of Channel
        As recorded.
    period_s : float
        As recorded, found in the episode `reference`.
    reference : EpisodeKey
    steps : tuple of Step
    tolerance : float
        Largest deviation of one time step, in sampling periods.
    """

    recordings: RecordingSource
    channels: tuple[Channel, ...]
    period_s: float
    reference: EpisodeKey
    steps: tuple[Step, ...] = ()
    tolerance: float = TIME_TOLERANCE

    def __call__(self, key: EpisodeKey) -> npt.NDArray[np.float64]:
        """Return one prepared episode, shape (n_samples, n_channels)."""
        recording = self.recordings(key)
        if not any(isinstance(step, Resample) for step in self.steps):
            check_even(recording, self.period_s, self.reference, self.tolerance)
        channels, period = self.channels, self.period_s
        for step in self.steps:
            recording = step.apply(recording, channels, period)
            channels, period = step.channels_after(channels), step.period_after(period)
        check_episode(recording.values, key, channels)
        return recording.values

    def restricted(self, keys: Iterable[EpisodeKey]) -> PreparedSource:
        """Return the same for fewer episodes, cheaper to send to another process."""
        return replace(self, recordings=restrict(self.recordings, keys))


@dataclass(frozen=True, eq=False)
class Recorded:
    """What a reader found: the population before its preparation."""

    channels: tuple[Channel, ...]
    units: Sequence[Unit]
    episodes: Sequence[EpisodeKey]
    recordings: RecordingSource
    sample_period_s: float | None = None  # None: from the time column of the first episode
    metadata: Mapping[str, Any] = field(default_factory=dict)
    tolerance: float = TIME_TOLERANCE


def episode_order(key: EpisodeKey) -> tuple[Any, ...]:
    """Sort key of episodes: natural order of unit, condition and episode, and no ties."""
    return natural_key(key.unit), key.unit, natural_key(key.condition), key.condition, natural_key(key.episode), key.episode


def assemble(recorded: Recorded, steps: Iterable[Step] = ()) -> Population:
    """Make the population: natural order, one sampling period, steps declared, names checked.

    Reads at most the first episode, for the sampling period.

    Raises
    ------
    DataError
        Empty, duplicate episodes or channels, no state, inputs before states.
    """
    check_structure(recorded.channels, recorded.episodes)
    roles = [c.role for c in recorded.channels]
    if roles != sorted(roles, key=lambda role: role is Role.INPUT):
        raise DataError(
            f"Channels should list states before inputs, found {[(c.name, c.role.value) for c in recorded.channels]}; reorder them."
        )
    episodes = tuple(sorted(recorded.episodes, key=episode_order))
    with_episodes = {key.unit for key in episodes}
    units = tuple(sorted((u for u in recorded.units if u.id in with_episodes), key=lambda u: (natural_key(u.id), u.id)))
    first = episodes[0]
    period = recorded.sample_period_s if recorded.sample_period_s is not None else estimate_period(recorded.recordings(first))
    period = check_period(period, "Population")
    source = PreparedSource(recorded.recordings, recorded.channels, period, first, tolerance=recorded.tolerance)
    return prepare(Population(recorded.channels, period, units, episodes, source, recorded.metadata), steps)


def prepare(population: Population, steps: Iterable[Step]) -> Population:
    """Declare preparation steps; they are applied to each episode when it is read.

    Parameters
    ----------
    population : Population
    steps : iterable of Step
        Applied in order, after those declared before.

    Returns
    -------
    Population
        With the channels and the sampling period that the steps leave.

    Raises
    ------
    ConfigError
        When a step does not fit the channels.

    Examples
    --------
    >>> from kros.data import from_arrays, prepare, steps, Channel, Role
    >>> raw = from_arrays({"a": [[[0.0], [1.0], [4.0], [9.0]]]}, (Channel("x", Role.STATE),), sample_period_s=0.1)
    >>> prepare(raw, [steps.Trim(start=1), steps.Scale(("x",), 2.0)]).read(raw.episodes[0]).ravel().tolist()
    [2.0, 8.0, 18.0]
    """
    added = tuple(steps)
    if not added:
        return population
    channels, period = population.channels, population.sample_period_s
    for step in added:
        channels, period = step.channels_after(channels), step.period_after(period)
    check_structure(channels, population.episodes)
    source = population.source
    if isinstance(source, PreparedSource):
        source = replace(source, steps=source.steps + added)
    else:
        source = PreparedSource(EvenRecordings(source), population.channels, population.sample_period_s, population.episodes[0], added)
    return replace(population, channels=channels, sample_period_s=period, source=source)
