"""One episode as recorded, and checks of its time and content: what makes an episode or a population unusable.

reader ── Recording ── steps ── Recording ── checks ── samples
"""

from __future__ import annotations

import logging
import unicodedata
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import replace
from hashlib import sha256
from numbers import Real
from pathlib import Path
from typing import Any, Self

import numpy as np

from ..core import AGREED, ROUNDING, DataError, limits, shortened
from ..core.arrays import Array, Flags, Index, frozen
from .population import OUTLIERS, Channel, EpisodeKey, Population, Role


@frozen
class CheckRule:
    """What recordings are refused for, and what is doubted."""

    time: float = 1e-3  # largest deviation of one time step, in sampling periods
    period: float = 1e-4  # largest relative difference of the sampling periods of two episodes
    end: float = AGREED  # of a sample: how far rounding may move the end of an even grid
    steps: int = 100  # of time at once, from which the sampling period is found
    spread: tuple[float, float] = (0.05, 0.95)  # quantiles of steps between which they count as unevenness
    samples: int = 3  # fewest: two consecutive states and one more
    wild: float = 1e3  # times the size of a channel, from which on a sample is wild
    # to the median unit, from which on the size of a channel is doubted; half its logarithm beside the other channels
    ratio: float = 8.0
    correlation: float = 0.5  # of channels, from which on its sign counts
    usual: float = 0.9  # share of the middle unit's episodes in which a correlation has its sign, to be a usual one
    held: float = 0.2  # share of an episode in which a state stays the same, from which on its sensor is doubted
    jump: float = 2.0  # change of a state between two samples, in ranges of most of them, beyond which it is doubted
    turn: float = 1 / 16  # of a full turn: the largest step of a channel that is doubted to be a wrapped angle
    step: float = 0.95  # quantile of the changes of a channel from sample to sample, which is its step
    constant: float = ROUNDING  # of the largest value: what filters and scales make of a constant


CHECK = CheckRule()


@frozen
class Recording:
    """One episode before or between preparation steps."""

    key: EpisodeKey
    values: Array  # shape (n_samples, n_channels)
    time_s: Array | None = None  # shape (n_samples,), s; None where the samples are known to be even

    def cut(self, start: int, stop: int) -> Recording:
        """Return samples `start` to `stop - 1`."""
        time = None if self.time_s is None else self.time_s[start:stop]
        return replace(self, values=self.values[start:stop], time_s=time)

    def distinct(self) -> Recording:
        """Return the same without samples that repeat the stamp before them.

        They do so with all values, as late loggers write, or at the end, as stopped recorders write.
        """
        time, x = self.time_s, self.values
        if time is None:
            return self
        again = 1 + np.flatnonzero(np.diff(time) == 0)
        drop = [k for k in again if time[k] == time[-1] or np.array_equal(x[k], x[k - 1], equal_nan=True)]
        return replace(self, values=np.delete(x, drop, axis=0), time_s=np.delete(time, drop))

    def usable(self, period_s: float) -> Recording:
        """Return the same without samples that hold NaN or infinity, with the time of the others, if two remain."""
        rows = usable(self.values).all(axis=1)
        rows |= rows.sum() < 2  # nothing to bridge: the check of the episode says what is wrong
        return replace(self, values=self.values[rows], time_s=self.times(period_s)[rows])

    def times(self, period_s: float) -> Array:
        """Return the time of every sample, even where none is recorded."""
        return np.arange(len(self.values), dtype=np.float64) * period_s if self.time_s is None else self.time_s


@frozen
class Recordings:
    """Episodes of a reader, read one at a time; a format has its own `read`. Can be pickled when `places` can."""

    places: Mapping[EpisodeKey, Any]  # where each episode is

    def __call__(self, key: EpisodeKey) -> Recording:
        """Return one episode."""
        if key not in self.places:
            raise DataError(f"Asked for {key}; it is not in this source; take keys from population.episodes.")
        return self.read(key).distinct()

    def read(self, key: EpisodeKey) -> Recording:
        """Return one episode as recorded."""
        raise NotImplementedError

    def file(self, place: Any) -> Path | None:
        """Return the one file that an episode is in, where it is in one."""
        return None

    def restricted(self, keys: Iterable[EpisodeKey]) -> Self:
        """Return the same for fewer episodes, cheaper to send to another process."""
        return replace(self, places={key: self.places[key] for key in keys})


def usable(values: Array) -> Flags:
    """Tell which samples are numbers of a size that can be computed with."""
    return np.abs(values) <= limits.MAX_VALUE


def title(key: EpisodeKey) -> str:
    """Return how a message names an episode, for example ``Episode 7 of unit 001011 (load)``."""
    return f"E{str(key)[1:]}"


def some(names: Sequence[str], most: int = 8) -> str:
    """Return the first of some names for a message, and how many more there are."""
    return ", ".join(names[:most]) + (f" and {len(names) - most} more" if len(names) > most else "")


def estimate_period(recording: Recording) -> float:
    """Return the median time step, rounded to six digits so that 0.0010000000000000009 s reads 0.001 s."""
    name, time = title(recording.key), np.zeros(0) if recording.time_s is None else recording.time_s
    if len(time) < 2:
        raise DataError(f"{name}: a sampling period needs at least two samples with time, found {len(time)}.")
    period = float(f"{np.median(np.diff(time)):.6g}")
    if not period > 0:
        raise DataError(f"{name}: the median time step is {period:g} s; name the column of time, in seconds.")
    return period


def check_increasing(recording: Recording, where: str = "") -> None:
    """Refuse time that stands still, runs backwards or is not a number."""
    time = recording.time_s
    if time is None:
        return
    bad = np.flatnonzero(~(np.diff(time) > 0))
    if bad.size:
        k, mean = int(bad[0]), (time[-1] - time[0]) / (len(time) - 1)
        raise DataError(
            f"{title(recording.key)}{where}: time should increase, found {time[k]:.9g} s at sample {k} and "
            f"{time[k + 1]:.9g} s at sample {k + 1} ({len(bad)} such steps); sort samples by time, or if stamps are "
            f"rounded, give the period in their place, --period {mean:.3g} or sample_period_s."
        )


def check_even(recording: Recording, period_s: float, reference: EpisodeKey, where: str = "") -> None:
    """Check that an episode is sampled evenly, at the population's period."""
    time = recording.time_s
    if time is None or len(time) < 2:
        return
    check_increasing(recording, where)
    steps, period = np.diff(time), estimate_period(recording)
    deviation = np.abs(steps - period)
    worst, room = int(deviation.argmax()), max(CHECK.period, CHECK.time / len(steps))
    if deviation[worst] > CHECK.time * period or abs(steps.mean() - period_s) > room * period_s:
        raise DataError(
            f"{title(recording.key)}{where}: uneven time, or not the {period_s:g} s of {reference}: found steps of "
            f"{period:g} s, and {steps[worst]:g} s at sample {worst}; declare "
            f'[[data.prepare]] step = "resample", period_s = {max(period, period_s):.3g}, or fix the source.'
        )


logger = logging.getLogger(__name__)


class NonFiniteError(DataError):
    """An episode holds NaN or infinity."""


def check_episode(values: Array, key: EpisodeKey, channels: Sequence[Channel], gaps: bool = False) -> None:
    """Check one episode's samples: shape, length, numbers, and that no state stands still while others move."""
    if values.ndim != 2 or values.shape[1] != len(channels):
        raise DataError(f"{title(key)}: needs {len(channels)} channels, found an array of shape {values.shape}.")
    if len(values) < CHECK.samples:
        raise DataError(f"{title(key)}: needs at least {CHECK.samples} samples, found {len(values)}; leave it out.")
    if not gaps and not (usable(values.min(axis=0)) & usable(values.max(axis=0))).all():
        check_finite(values, key, channels, first=0)
    rests = constant(values)
    still = [i for i, c in enumerate(channels) if c.role is Role.STATE and rests[i]]
    moving = [c.name for i, c in enumerate(channels) if still and not rests[i]]
    if moving:
        stays = f"state {channels[still[0]].name!r} stays at {values[0, still[0]]:g} in all {len(values)} samples"
        reason = f"while {', '.join(map(repr, moving))} move, so its sensor is stuck or the column is wrong"
        raise DataError(f"{title(key)}: {stays} {reason}; leave the episode out, or the channel.")


def constant(values: Array) -> Flags:
    """Tell which signals, shape (n_samples, n_channels), never change, but for rounding."""
    known = np.isfinite(values[0])
    first = np.where(known, values[0], 0.0)
    room = CHECK.constant * np.abs(first)
    return known & (values.min(axis=0) >= first - room) & (values.max(axis=0) <= first + room)


def check_finite(values: Array, key: EpisodeKey, channels: Sequence[Channel], first: int) -> None:
    """Raise NonFiniteError where a channel holds NaN, infinity or what is as good as that."""
    for channel, signal in zip(channels, values.T, strict=True):
        bad = np.flatnonzero(~usable(signal))
        if bad.size:
            kinds = {"NaN": np.isnan, f"above {limits.MAX_VALUE:g}": np.isfinite, "infinity": np.isinf}
            what = " and ".join(kind for kind, is_so in kinds.items() if is_so(signal[bad]).any())
            where = f"sample {first + bad[0]}" if bad.size == 1 else f"samples {first + bad[0]}-{first + bad[-1]}"
            bridge = 'bridge short gaps by [[data.prepare]] step = "resample"'
            advice = f'fix the source, {bridge}, or set data.on_nan = "drop_episode"'
            raise NonFiniteError(f"{title(key)}: channel {channel.name!r} has {bad.size} {what} at {where}; {advice}.")


class GroupWatch:
    """What only episodes of one unit and condition show together: channels that never move, and wild samples."""

    def __init__(self, channels: Sequence[Channel]) -> None:
        self._channels = channels
        # of every episode: quantiles (3, n), ranges (n,), the samples that are farthest from the median, values there,
        # and where channels rest, NaN for one that moves
        self._looks: dict[EpisodeKey, tuple[Array, Array, Index, Array, Array]] = {}

    def add(self, key: EpisodeKey, values: Array) -> None:
        """Look at one more episode, all of whose samples are usable."""
        outside = max(1, len(values) // 100)  # at each end; one at least, for short episodes
        rows = [outside, len(values) // 2, len(values) - 1 - outside]
        quantiles = np.partition(values, rows, axis=0)[rows]
        at = np.abs(values - quantiles[1]).argmax(axis=0)
        resting = np.where(constant(values), values[0], np.nan)
        self._looks[key] = quantiles, np.ptp(values, axis=0), at, values[at, np.arange(len(at))], resting

    def wild(self) -> Iterator[tuple[EpisodeKey, str]]:
        """Yield episodes where |x - median| > 1e3 max(q99 - q1, |q1|, |q99|, median range) > 0, and the place."""
        ranges = [look[1] for look in self._looks.values()]
        usual = np.quantile(ranges, 0.5, axis=0, method="lower") if ranges else np.zeros(1)
        for key, ((low, middle, high), _, samples, values, _) in self._looks.items():
            size = np.max([high - low, np.abs(low), np.abs(high), usual], axis=0)  # it may rest in 99 % of an episode
            for i in map(int, np.flatnonzero((np.abs(values - middle) > CHECK.wild * size) & (size > 0))):
                actual = f"{values[i]:g} at sample {samples[i]}"
                most = f"98 % of its samples are from {low[i]:g} to {high[i]:g}"
                yield key, f"channel {self._channels[i].name!r} is {actual}, and {most}"

    def problems(self) -> Iterator[str]:
        """Yield a sentence for all wild samples, and for every input or state that never changed."""
        for key, problem in self.wild():
            yield f"{title(key)}: {problem}; fix the source, or leave the episode out."
        rests = np.array([look[-1] for look in self._looks.values()]).T
        for channel, rest in zip(self._channels, rests, strict=False):
            differs = channel.role is Role.INPUT and (rest != rest[0]).any()  # from episode to episode
            if channel.role is Role.TRUTH or differs or np.isnan(rest).any():
                continue
            key = next(iter(self._looks))
            what = f"Unit {key.unit} ({key.condition}): {channel.role.value} {channel.name!r} stays where it is"
            place = f"in each of {len(rest)} episodes, in the first at {rest[0]:g}"
            yield f"{what} {place}; check the sensor and the column, or remove the channel or the unit."


def check_names(kind: str, names: Iterable[Any]) -> None:
    """Refuse names that are empty, no text, or hold characters that no file and no table can show."""
    for name in names:
        is_text = isinstance(name, str) and name.strip()
        if not is_text or any(unicodedata.category(c) in ("Cc", "Cs") for c in name):
            raise DataError(f"The name of a {kind} should be printable text, found {name!r}; rename it.")


def repeated(items: Iterable[Any]) -> list[str]:
    """Return what is there more than once, as text."""
    return [str(item) for item, count in Counter(items).items() if count > 1]


def check_period(period_s: Any, what: str) -> float:
    """Return a sampling period that is a number of seconds above zero."""
    is_number = isinstance(period_s, Real) and not isinstance(period_s, bool)
    if not is_number or not 1 / limits.MAX_VALUE < float(period_s) < limits.MAX_VALUE:
        wanted, actual = "should be a number of seconds above zero", shortened(repr(period_s))
        raise DataError(f"{what}: the sampling period {wanted}, found {actual}; give it in seconds.")
    return float(period_s)


def check_structure(channels: Sequence[Channel], episodes: Sequence[EpisodeKey]) -> None:
    """Check names: none empty, at least one state, no channel and no episode twice."""
    names = [c.name for c in channels]
    check_names("channel", names)
    for kind in ("unit", "condition", "episode"):
        check_names(kind, dict.fromkeys(getattr(key, kind) for key in episodes))
    if twice := repeated(names):
        raise DataError(f"Channel names should differ, found {twice} more than once in {names}; rename them.")
    states = [c.name for c in channels if c.role is Role.STATE]
    if not states:
        roles = [(c.name, c.role.value) for c in channels]
        raise DataError(f"A population needs at least one channel with role 'state', found {roles}; declare one.")
    truths = {c.name: c.of for c in channels if c.of or c.role is Role.TRUTH}
    owners, declared = set(truths.values()), {c.name for c in channels if c.role is Role.TRUTH}
    if set(truths) != declared or len(owners) < len(truths) or not owners <= set(states):
        raise DataError(f"A truth says with `of` which state it is the truth of, one of {states}, found {truths}.")
    if not episodes:
        raise DataError("The population is empty: no episode was found; check the source and the reader.")
    if twice := repeated(episodes):
        raise DataError(f"Duplicate episodes: {some(twice)}; rename or remove the copies.")


def check_population(population: Population, allow_single: bool = False) -> None:
    """Check what needs no reading: not empty, no duplicates, a state, a measured state, more than one unit."""
    check_structure(population.columns, population.episodes)
    if not population.measured:
        raise DataError(f"No state of {list(population.states)} is measured; declare measured = true for at least one.")
    if not population.inputs:
        roles = [(c.name, c.role.value) for c in population.columns]
        raise DataError(f"No channel has the role 'input', found {roles}; declare what drives a machine.")
    recorded = {key.unit for key in population.episodes}
    units = [u.id for u in population.units if u.group != OUTLIERS and u.id in recorded]
    if len(units) < 2 and not allow_single:
        actual = f"found {len(units)} ({', '.join(units) or 'none'}): uncertainty is the difference between units"
        advice = 'add recordings of more units, or stop after identification ("--until identify")'
        raise DataError(f"A population needs at least two units outside the group {OUTLIERS!r}, {actual}; {advice}.")


def usable_episodes(population: Population, on_nan: str = "error") -> Iterator[tuple[EpisodeKey, Array, str]]:
    """Yield the episodes of one unit and condition that pass all checks, with their samples and digest."""
    watch, usable = GroupWatch(population.columns), 0
    for key in population.episodes:
        try:
            values = population.source(key)
        except NonFiniteError as error:
            if on_nan != "drop_episode":
                raise
            logger.warning("Dropped, as data.on_nan asks: %s", error)
            continue
        watch.add(key, values)
        usable += 1
        yield key, values, digest_of(values)
    for problem in watch.problems():
        raise DataError(problem)
    if not usable:
        raise DataError(f"Unit {key.unit} ({key.condition}): every episode was dropped; leave the unit out.")


def digest_of(values: Array) -> str:
    """Return the digest of all samples of an episode, shape (n_samples, n_channels)."""
    values = np.ascontiguousarray(values) + 0.0  # one zero
    digest = sha256(repr(values.shape).encode())
    digest.update(values.data)
    return digest.hexdigest()


def copies_among(digests: Iterable[tuple[EpisodeKey, str]]) -> Iterator[tuple[EpisodeKey, EpisodeKey]]:
    """Yield the episodes that are copies of earlier ones, with these."""
    first = dict[str, EpisodeKey]()
    for key, digest in digests:
        if first.setdefault(digest, key) != key:
            yield key, first[digest]


def refuse_copies(digests: Iterable[tuple[EpisodeKey, str]]) -> None:
    """Refuse copies, which put test episodes into training and one machine's data into another."""
    for key, other in copies_among(digests):
        raise DataError(f"{title(key)} is a copy of {other}, so that test data leak into training; remove one of them.")
