"""One pass over all recordings: every episode read and checked once, what looks wrong said, and the split.

Population --survey--> Population that can be used, RecordingFacts
"""

import logging
from collections import deque
from collections.abc import Collection, Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, lru_cache
from pathlib import Path
from typing import Any

import numpy as np

from ..core import ITERATED, Array, DataError, Names, Work, grouped
from ..core.artifacts import Storable, digest_of, file_digest
from ..core.files import is_file, link_or_copy, stamp_of
from ..data import DEFAULT_CONDITION, OUTLIERS, EpisodeKey, Population, scaling_of, split_episodes
from ..data.population import Keys
from ..data.prepare import PreparedSource
from ..data.readers.parquet import GroupRecord, read_parquet, write_group, write_index
from ..data.recording import check_population, refuse_copies, some, title, usable, usable_episodes
from .likeness import apart, course, moments, odd, unlike

log = logging.getLogger(__name__)
UNLOADED = "noload"
_PARTS = ("train", "test")


@dataclass(frozen=True)
class RecordingFacts(Storable):
    """What is known about recordings once all were read."""

    KIND = "facts"
    identify_on: str  # condition whose models feed synthesis
    groups: dict[str, str]
    train: Keys
    test: Keys
    resolution: dict[str, float]  # quantisation step found in every measured channel
    dropped: Names = ()  # episodes that were left out, with the reason
    alerts: Names = ()  # what looks wrong in the recordings without making them unusable
    reserve: Names = ()
    digests: Names = ()  # of the samples of the training episodes, then of the test episodes
    recordings: str = "recordings"  # where they are, seen from the folder of a run

    @cached_property
    def pooled(self) -> Names:
        """Units that take part in pooled results."""
        return tuple(u for u, group in self.groups.items() if group != OUTLIERS)

    def keys(self, part: str, unit: str | None = None, condition: str | None = None) -> Keys:
        """Return the episodes of a part, ``train`` or ``test``, of a unit, a condition or both."""
        keys: Sequence[EpisodeKey] = getattr(self, part) if unit is None else self._by_unit[part].get(unit, ())
        return tuple(k for k in keys if condition in (None, k.condition))

    @cached_property
    def _by_unit(self) -> dict[str, dict[str, list[EpisodeKey]]]:
        """Episodes by part and unit."""
        return {part: grouped(getattr(self, part), lambda key: key.unit) for part in _PARTS}

    def mark(self, task: tuple[Population, Sequence[EpisodeKey], Any]) -> str:
        """Return a digest of what a result follows from: samples and channels of episodes, and how they are used."""
        population, keys, how = task
        samples = [self._digests[key] for key in keys]
        return digest_of(samples, keys, population.columns, population.sample_period_s, repr(how))

    @cached_property
    def _digests(self) -> dict[EpisodeKey, str]:
        return dict(zip((*self.train, *self.test), self.digests, strict=False))


_Task = tuple[Population, Path | None, str]  # a unit in a condition, where it is written, if anywhere, and on_nan


@dataclass(frozen=True)
class _EpisodeFacts:
    """What a worker saw in one episode."""

    key: EpisodeKey
    digest: str
    n_samples: int
    course: Array  # see `likeness`
    moments: Array  # see `likeness`


@dataclass(frozen=True)
class _GroupFacts:
    """What a worker read in one unit and condition; `written` is the digest of the file that it wrote."""

    record: GroupRecord | None
    written: str | None
    resolution: dict[str, float]
    episodes: list[_EpisodeFacts]


@dataclass(frozen=True)
class SurveyOptions:
    """Options of `survey`, by name."""

    test: Iterable[str] | None = None  # test episodes
    identify_on: str | None = None  # condition
    on_nan: str = "error"
    reserve: Sequence[str] = ()  # units that are set aside
    fewest: int = 0  # samples that every episode needs


@dataclass(frozen=True)
class Copy:
    """Where a survey writes the recordings as Parquet, and an earlier copy whose unchanged files are taken."""

    folder: Path
    earlier: Path

    def reuse(self, group: _GroupFacts) -> bool:
        """Take the file of the earlier copy where it is as it was written; tell whether it was."""
        path = self.earlier / ("" if group.record is None else group.record.file)
        if not is_file(path) or file_digest(path) != group.written:
            return False
        link_or_copy(path, self.folder / path.name)
        return True


def survey(
    population: Population, work: Work | None = None, copy: Copy | None = None, **options: Any
) -> tuple[Population, RecordingFacts]:
    """Read all recordings once, without those that `work` knows from earlier, with options of `SurveyOptions`."""
    chosen = SurveyOptions(**options)
    folder = None if copy is None else copy.folder
    if folder is not None:
        folder.mkdir(parents=True)
    tasks: list[_Task] = [(population.select([u], [c]), folder, chosen.on_nan) for u, c, _ in population.groups()]
    marks = _marks(population.source, (part.episodes for part, *_ in tasks), chosen.on_nan, folder is None)
    recalled = (work or Work()).recall(
        "read", _read_group, tasks, marks, _GroupFacts, lambda known: copy is None or copy.reuse(known)
    )
    groups = list(recalled)
    if folder is None:
        digests = {e.key: e.digest for group in groups for e in group.episodes}
        refuse_copies(digests.items())
        retained = replace(population, episodes=tuple(k for k in population.episodes if k in digests))
    else:
        write_index(population, [g.record for g in groups if g.record is not None], folder, converted=False)
        retained = read_parquet(folder)
    facts = _facts(population, retained, groups, chosen)
    for alert in facts.alerts:
        log.warning("%s", alert)
    return retained, facts


def _marks(source: PreparedSource, groups: Iterable[Sequence[EpisodeKey]], *declared: Any) -> Iterator[str | None]:
    """Yield digests of all that the samples of every group follow from; None where the recordings are in no file."""
    read = source.recordings
    settings = [(name, value) for name, value in vars(read).items() if name != "places"]
    about = (source.channels, source.period_s, source.steps, source.gaps)
    stamp, how = lru_cache(stamp_of), digest_of(about, type(read).__name__, settings, declared)
    for keys in groups:
        files = [read.file(read.places[key]) for key in keys]
        rows = [(key, read.places[key], stamp(f)) for key, f in zip(keys, files, strict=True) if f is not None]
        yield digest_of(how, rows) if len(rows) == len(keys) else None


def _facts(
    population: Population, retained: Population, read: Sequence[_GroupFacts], options: SurveyOptions
) -> RecordingFacts:
    """Return the facts of all episodes that take part."""
    left, part = set(retained.episodes), [u for u in retained.unit_ids if u not in options.reserve]
    splits, groups = split_episodes(retained.select(part), options.test), {u: retained.unit(u).group for u in part}
    episodes = [e for group in read for e in group.episodes if e.key.unit in groups]
    short = [f"{title(e.key)} has {e.n_samples}" for e in episodes if e.n_samples < options.fewest]
    if short:
        raise DataError(f"Every episode needs at least {options.fewest} samples after preparation; {some(short)}.")
    train, test = (tuple(k for s in splits.values() for k in getattr(s, name)) for name in _PARTS)
    digests, measured = {e.key: e.digest for e in episodes}, retained.measured
    of_states = np.array([e.course for e in episodes])[..., : len(retained.states)]
    return RecordingFacts(
        identify_on=condition_of(population.select(part), options.identify_on),
        groups=groups,
        train=train,
        test=test,
        resolution={m: float(np.quantile([g.resolution[m] for g in read], 0.5, method="lower")) for m in measured},
        dropped=tuple(str(k) for k in population.episodes if k not in left),
        alerts=(*_unlike(retained, read, groups), *odd([title(e.key) for e in episodes], retained.states, of_states)),
        reserve=tuple(options.reserve),
        digests=tuple(digests[key] for key in train + test),
    )


def _unlike(population: Population, read: Sequence[_GroupFacts], units: Collection[str]) -> list[str]:
    """Return what is said about units whose recordings are unlike those of most, in any condition."""
    names, texts = [c.name for c in population.channels], list[str]()
    chosen = (group.episodes for group in read if group.episodes[0].key.unit in units)
    for of in grouped(chosen, lambda episodes: episodes[0].key.condition).values():
        if len(of) > 2:
            texts += unlike(names, {group[0].key.unit: {title(e.key): e.moments for e in group} for group in of})
            texts += apart(names, {group[0].key.unit: np.array([e.course for e in group]) for group in of})
    return list(dict.fromkeys(texts))


def check_usable(
    population: Population, test: Iterable[str] | None, identify_on: str | None, single_allowed: bool
) -> None:
    """Refuse what can be refused from names alone, before anything is read or written."""
    check_population(population, allow_single=single_allowed)
    known = dict.fromkeys(key.episode for key in population.episodes)
    if unknown := [name for name in test or () if name not in known]:
        raise DataError(f"split.test: no episode is named {some(unknown)}; there are {some(list(known))}.")
    split_episodes(population, test)
    condition_of(population, identify_on)


def condition_of(population: Population, wanted: str | None) -> str:
    """Return the condition whose models feed synthesis: the one named, else that without load, else the first."""
    conditions = population.conditions
    if wanted is None:
        return UNLOADED if UNLOADED in conditions else next(iter(conditions), DEFAULT_CONDITION)
    if wanted not in conditions:
        raise DataError(f"data.identify_on = {wanted!r}: the recordings have the conditions {', '.join(conditions)}.")
    return wanted


def _read_group(task: _Task) -> _GroupFacts:
    """Read, check and, where asked, write one unit and condition."""
    (population, folder, on_nan), record, written = task, None, None
    episodes, resolution = list[_EpisodeFacts](), dict[str, float]()

    def episodes_in_turn() -> Iterator[tuple[EpisodeKey, Array, str]]:
        for key, values, digest in usable_episodes(population, on_nan):
            if not episodes:
                resolution.update(_resolution(population, key, values))
            recorded = values[:, : len(population.channels)]
            episodes.append(_EpisodeFacts(key, digest, len(values), course(recorded), moments(recorded)))
            yield key, values, digest

    if folder is None:
        deque(episodes_in_turn(), maxlen=0)
    else:
        record = write_group(population, folder, episodes_in_turn())
        written = file_digest(folder / record.file)
    return _GroupFacts(record, written, resolution, episodes)


def _resolution(population: Population, key: EpisodeKey, prepared: Array) -> dict[str, float]:
    """Return the smallest step of every measured channel, as recorded where samples are interpolated."""
    source, signals = population.source, dict(zip([c.name for c in population.columns], prepared.T, strict=True))
    if any(step.makes_even for step in source.steps):
        for channel, column in zip(source.channels, source.recordings(key).values.T, strict=True):
            scaling = scaling_of(population.scaling, channel.name)
            signals[channel.name] = column * (scaling.factor / scaling.converted)
    return {name: smallest_step(signals[name]) for name in population.measured}


def smallest_step(signal: Array) -> float:
    """Return the smallest step between samples, the quantisation of a digital sensor; rounding where there is none."""
    signal = signal[usable(signal)]
    steps, floor = np.abs(np.diff(signal)), ITERATED * float(np.abs(signal).max())
    steps = steps[steps > floor]
    return float(steps.min()) if steps.size else floor
