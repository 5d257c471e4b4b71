"""Checks of content: what makes an episode or a population unusable, said in full before anything is computed from it."""

from __future__ import annotations

import logging
import math
import unicodedata
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from numbers import Real
from typing import Any

import numpy as np
import numpy.typing as npt

from ..core import limits
from ..core.errors import ConfigError, DataError
from ..core.files import shortened
from .copies import digest_of, refuse_copies
from .population import OUTLIERS, Channel, EpisodeKey, Population, Role, TrueChannel
from .recording import title, usable

logger = logging.getLogger(__name__)
Look = Callable[[EpisodeKey, npt.NDArray[np.float64]], None]

ON_NAN = ("error", "drop_episode")
MIN_SAMPLES = 3  # two consecutive states and one more
WILD = 1e3  # times the size of a channel, from which on a sample is wild
_ROUNDING = 1e-12  # of the largest value: what filters and scales make of a constant


class NonFiniteError(DataError):
    """An episode holds NaN or infinity."""


def check_episode(
    values: npt.NDArray[np.float64], key: EpisodeKey, channels: Sequence[Channel], *, gaps: bool = False
) -> None:
    """Check one episode's samples."""
    if values.ndim != 2 or values.shape[1] != len(channels):
        raise DataError(
            f"{title(key)}: {len(channels)} channels {[c.name for c in channels]} are declared, found an array of shape "
            f"{values.shape}; transpose or correct it."
        )
    if len(values) < MIN_SAMPLES:
        raise DataError(
            f"{title(key)}: at least {MIN_SAMPLES} samples are needed, found {len(values)}; leave the episode out or record longer."
        )
    if not gaps and not usable(values).all():
        check_finite(values, key, channels)
    _check_moving(values, key, channels)


def _check_moving(values: npt.NDArray[np.float64], key: EpisodeKey, channels: Sequence[Channel]) -> None:
    """Refuse a state that stands still for the whole episode while anything else moves."""
    still = [i for i, c in enumerate(channels) if c.role is Role.STATE and is_constant(values[:, i])]
    if not still:
        return
    moving = [c.name for i, c in enumerate(channels) if i not in still and not is_constant(values[:, i])]
    if moving:
        raise DataError(
            f"{title(key)}: state {channels[still[0]].name!r} stays at {values[0, still[0]]:g} in all {len(values)} samples while "
            f"{', '.join(repr(name) for name in moving)} move, so its sensor is stuck or the column is wrong; leave the episode out, or the channel."
        )


def is_constant(column: npt.NDArray[np.float64]) -> bool:
    """Tell whether a signal never changes, but for rounding; a changing one is recognised early."""
    room = _ROUNDING * abs(column[0])
    lower, upper = column[0] - room, column[0] + room
    return bool(lower <= column[len(column) // 2] <= upper and np.all((column >= lower) & (column <= upper)))


def check_finite(
    values: npt.NDArray[np.float64],
    key: EpisodeKey,
    channels: Sequence[Channel],
    first: int = 0,
    columns: Iterable[int] | None = None,
) -> None:
    """Raise NonFiniteError where a channel holds NaN, infinity or what is as good as that."""
    for column in range(len(channels)) if columns is None else columns:
        bad = np.flatnonzero(~usable(values[:, column]))
        if bad.size:
            kinds = " and ".join(sorted({_kind(v) for v in values[bad, column]}))
            where = f"sample {first + bad[0]}" if bad.size == 1 else f"samples {first + bad[0]}-{first + bad[-1]}"
            raise NonFiniteError(
                f"{title(key)}: channel {channels[column].name!r} has {bad.size} {kinds} at {where}; fix the source or set "
                'data.on_nan = "drop_episode".'
            )


@dataclass(frozen=True, eq=False)
class _Suspects:
    """Samples of a channel that are far from the others of their episode."""

    key: EpisodeKey
    channel: int
    samples: npt.NDArray[np.int64]
    values: npt.NDArray[np.float64]
    middle: float  # median of the episode
    low: float
    high: float  # 98 % of the samples are between them

    def beyond(self, range_elsewhere: float) -> npt.NDArray[np.int64]:
        """Return which are wild: |x - median| > 1e3 max(q99 - q1, |q1|, |q99|, range elsewhere)."""
        size = max(self.high - self.low, abs(self.low), abs(self.high), range_elsewhere)
        return np.flatnonzero(np.abs(self.values - self.middle) > WILD * size) if size > 0 else np.zeros(0, np.int64)


class WildWatch:
    """Notice samples that are wild beside their episode and beside the other episodes of one unit and condition.

    A channel may rest in 99 % of an episode and then move (steps, flags, saturation): its size is that of its values, and what it moves by
    in half of the other episodes.
    """

    def __init__(self, channels: Sequence[Channel]) -> None:
        self._channels = channels
        self._ranges: dict[EpisodeKey, npt.NDArray[np.float64]] = {}
        self._suspects: list[_Suspects] = []

    def add(self, key: EpisodeKey, values: npt.NDArray[np.float64]) -> None:
        """Look at one more episode, all of whose samples are usable."""
        self._ranges[key] = np.ptp(values, axis=0)
        for i, column in enumerate(values.T):
            few = np.sort(column[:: max(1, len(column) // 64)])
            if self._ranges[key][i] <= WILD * (few[-2] - few[1]):
                continue  # a few samples show already that the channel moves as much
            low, middle, high = np.percentile(column, (1, 50, 99))
            far = np.flatnonzero(np.abs(column - middle) > WILD * (high - low))
            if far.size:
                self._suspects.append(_Suspects(key, i, far, column[far], middle, low, high))

    def find(self) -> Iterator[tuple[EpisodeKey, str]]:
        """Yield the episodes with wild samples, and what is wrong with them."""
        for s in self._suspects:
            others = sorted(r[s.channel] for key, r in self._ranges.items() if key != s.key)
            wild = s.beyond(others[(len(others) - 1) // 2] if others else 0.0)
            if wild.size:
                yield (
                    s.key,
                    f"channel {self._channels[s.channel].name!r} is {s.values[wild[0]]:g} at sample {s.samples[wild[0]]}, and 98 % of its "
                    f"samples are from {s.low:g} to {s.high:g} ({wild.size} such samples)",
                )


def _kind(value: float) -> str:
    return "NaN" if np.isnan(value) else "infinity" if np.isinf(value) else f"above {limits.MAX_VALUE:g}"


class RestWatch:
    """Notice inputs and states that never change over all episodes of one unit and condition."""

    def __init__(self, channels: Sequence[Channel]) -> None:
        self._columns = [(i, c.name, c.role) for i, c in enumerate(channels) if c.role in (Role.INPUT, Role.STATE)]
        self._resting: dict[int, float] = {}
        self._seen = 0

    def add(self, values: npt.NDArray[np.float64]) -> None:
        """Look at one more episode."""
        resting = {i: float(values[0, i]) for i, _, _ in self._columns if is_constant(values[:, i])}
        if self._seen:
            states = {i for i, _, role in self._columns if role is Role.STATE}
            resting = {i: v for i, v in self._resting.items() if i in resting and (i in states or resting[i] == v)}
        self._resting = resting
        self._seen += 1

    def check(self, unit: str, condition: str) -> None:
        """Raise DataError where an input or a state never changed."""
        for i, name, role in self._columns:
            if i not in self._resting:
                continue
            if role is Role.STATE:
                raise DataError(
                    f"Unit {unit} ({condition}): state {name!r} stays where it is in each of {self._seen} episodes, in the first at "
                    f"{self._resting[i]:g}; check the sensor and the column, or leave the unit out."
                )
            raise DataError(
                f"Unit {unit} ({condition}): input {name!r} stays at {self._resting[i]:g} in all {self._seen} "
                "episodes, so nothing can be learned from it; "
                "check the column, or remove the channel."
            )


def check_names(kind: str, names: Iterable[Any]) -> None:
    """Refuse names that are empty, no text, or hold characters that no file and no table can show."""
    for name in names:
        if not isinstance(name, str) or not name.strip():
            raise DataError(f"The name of every {kind} should be text that is not empty, found {name!r}; name it.")
        if any(unicodedata.category(c) in ("Cc", "Cs") for c in name):
            raise DataError(
                f"The name of a {kind} should hold printable characters in UTF-8 only, found {name!r}; rename it."
            )


def check_period(period_s: Any, what: str) -> float:
    """Return a sampling period that is a number of seconds above zero."""
    try:
        seconds = math.nan if isinstance(period_s, bool) or not isinstance(period_s, Real) else float(period_s)
    except OverflowError:
        seconds = math.inf
    if not 1 / limits.MAX_VALUE < seconds < limits.MAX_VALUE:
        found = shortened(repr(period_s))
        raise DataError(
            f"{what}: the sampling period should be a number of seconds above zero, found {found}; give it in seconds."
        )
    return seconds


def check_structure(channels: Sequence[Channel], episodes: Sequence[EpisodeKey]) -> None:
    """Check names: none empty, at least one state, no channel and no episode twice."""
    check_names("channel", [c.name for c in channels])
    for kind in ("unit", "condition", "episode"):
        check_names(kind, dict.fromkeys(getattr(key, kind) for key in episodes))
    twice = [name for name, count in Counter(c.name for c in channels).items() if count > 1]
    if twice:
        raise DataError(
            f"Channel names should differ, found {twice} more than once in {[c.name for c in channels]}; rename them."
        )
    if not any(c.role is Role.STATE for c in channels):
        raise DataError(
            f"A population needs at least one channel with role 'state', found {[(c.name, c.role.value) for c in channels]}; declare one."
        )
    _check_truths(channels)
    if not episodes:
        raise DataError("The population is empty: no episode was found; check the source and the reader.")
    doubled = [key for key, count in Counter(episodes).items() if count > 1]
    if doubled:
        raise DataError(
            f"Duplicate episodes: {doubled[0]} occurs {episodes.count(doubled[0])} times ({len(doubled)} such episodes); "
            "rename or remove the copies."
        )


def _check_truths(channels: Sequence[Channel]) -> None:
    """Refuse truths of what is no state, and two of the same."""
    states, owners = (
        [c.name for c in channels if c.role is Role.STATE],
        [getattr(c, "of", "") for c in channels if c.role is Role.TRUTH],
    )
    if (
        set(owners) <= set(states)
        and len(set(owners)) == len(owners)
        and all(isinstance(c, TrueChannel) == (c.role is Role.TRUTH) for c in channels)
    ):
        return
    raise DataError(
        f"A channel with role 'truth' says with `of` which state it is the truth of, each of another one of {states}, found "
        f"{[(c.name, getattr(c, 'of', '')) for c in channels if isinstance(c, TrueChannel) or c.role is Role.TRUTH]}; correct them."
    )


def check_population(population: Population, allow_single: bool = False) -> None:
    """Check what can be told without reading: not empty, no duplicates, a state, a measured state, more than one unit."""
    check_structure(population.columns, population.episodes)
    if not population.measured:
        raise DataError(
            f"No state of {list(population.states)} is measured, so an observer would have nothing to correct with; "
            "declare measured = true for at least one."
        )
    if not allow_single:
        recorded = {key.unit for key in population.episodes}
        units = [u.id for u in population.units if u.group != OUTLIERS and u.id in recorded]
        if len(units) < 2:
            raise DataError(
                f"A population needs at least two units outside the group {OUTLIERS!r}, found {len(units)} "
                f"({', '.join(units) or 'none'}): uncertainty is the difference "
                'between units; add recordings of more units, or stop after identification ("--until identify").'
            )


def scan_digests(
    population: Population, on_nan: str = "error", look: Look | None = None
) -> list[tuple[EpisodeKey, str]]:
    """Read and check every episode, and return those that are left with their digests; `look` is shown the samples of each."""
    kept = [
        (key, digest)
        for _, _, keys in population.groups()
        for key, _, digest in usable_episodes(population, keys, on_nan, look)
    ]
    refuse_copies(kept)
    return kept


def usable_episodes(
    population: Population, keys: Iterable[EpisodeKey], on_nan: str, look: Look | None = None
) -> Iterator[tuple[EpisodeKey, npt.NDArray[np.float64], str]]:
    """Yield the episodes of one unit and condition that pass all checks, all columns of their samples and their digest."""
    if on_nan not in ON_NAN:
        raise ConfigError(f"data.on_nan should be one of {list(ON_NAN)}, found {on_nan!r}; correct it.")
    columns = population.columns
    watch, wild = RestWatch(columns), WildWatch(columns)
    key = None
    for key in keys:
        try:
            values = population.source(key)
            check_episode(values, key, columns)
        except NonFiniteError as error:
            if on_nan == "error":
                raise
            logger.warning("Dropped, as data.on_nan asks: %s", error)
            continue
        watch.add(values)
        wild.add(key, values)
        if look is not None:
            look(key, values)
        yield key, values, digest_of(values)
    for episode, problem in wild.find():
        raise DataError(f"{title(episode)}: {problem}; fix the source, or leave the episode out.")
    if key is not None:
        watch.check(key.unit, key.condition)
