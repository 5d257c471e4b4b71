"""One pass over all recordings: every episode read and checked once, and split into training and test.

Population --survey--> Population that can be used, RecordingFacts
"""

from __future__ import annotations

import logging
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from ..core.artifacts import load_artifact, loader
from ..core.errors import DataError
from ..core.files import is_file, link_or_copy
from ..core.store import file_digest
from ..core.work import Work
from .alerts import period_alerts, scale_alerts, size_of
from .checks import check_population, refuse_copies, scan_digests
from .flat_tops import Ends, FlatTops, FoundLimit, ends_of, found_limit, smallest_step
from .population import DEFAULT_CONDITION, OUTLIERS, EpisodeKey, Population, split_episodes
from .prepare import recording_marks
from .readers.parquet import GroupRecord, read_parquet, write_group, write_index
from .recording import some, title

Array = npt.NDArray[np.float64]
log = logging.getLogger(__name__)
UNLOADED = "noload"
_PARTS = ("train", "test")
_TEXTS = ("dropped", "alerts", "reserve")


@dataclass(frozen=True)
class RecordingFacts:
    """What is known about recordings once all were read."""

    identify_on: str  # condition whose models feed synthesis
    groups: dict[str, str]
    train: tuple[EpisodeKey, ...]
    test: tuple[EpisodeKey, ...]
    resolution: dict[str, float]  # quantisation step found in every measured channel
    dropped: tuple[str, ...] = ()  # episodes that were left out, with the reason
    alerts: tuple[str, ...] = ()  # what looks wrong in the recordings without making them unusable
    reserve: tuple[str, ...] = ()
    limits: Mapping[str, FoundLimit] = field(default_factory=dict)  # of states that are not measured
    digests: Mapping[EpisodeKey, str] = field(default_factory=dict)

    @cached_property
    def pooled(self) -> tuple[str, ...]:
        """Units that take part in pooled results."""
        return tuple(u for u, group in self.groups.items() if group != OUTLIERS)

    def keys(self, part: str, unit: str | None = None, condition: str | None = None) -> tuple[EpisodeKey, ...]:
        """Return the episodes of a part, ``train`` or ``test``, of a unit, a condition or both."""
        keys: Sequence[EpisodeKey] = getattr(self, part) if unit is None else self._by_unit.get((part, unit), ())
        return tuple(k for k in keys if condition in (None, k.condition))

    @cached_property
    def _by_unit(self) -> dict[tuple[str, str], list[EpisodeKey]]:
        """Episodes by part and unit."""
        episodes: dict[tuple[str, str], list[EpisodeKey]] = {}
        for part in _PARTS:
            for key in getattr(self, part):
                episodes.setdefault((part, key.unit), []).append(key)
        return episodes

    def marks(self, keys: Iterable[EpisodeKey]) -> tuple[str, ...] | None:
        """Return the digests of some episodes; None where that of one of them is not known."""
        digests = tuple(self.digests.get(key, "") for key in keys)
        return digests if all(digests) else None

    def content(self) -> dict[str, Any]:
        """Return the facts in JSON's types."""
        facts = {name: getattr(self, name) for name in ("identify_on", "groups", "resolution", *_TEXTS)}
        for part in _PARTS:
            facts[part] = [[k.unit, k.condition, k.episode] for k in getattr(self, part)]
        facts["limits"] = {name: asdict(limit) for name, limit in self.limits.items()}
        if self.digests:
            facts["digests"] = {part: [self.digests.get(k) for k in getattr(self, part)] for part in _PARTS}
        return facts

    @classmethod
    @loader
    def load(cls, folder: Path) -> RecordingFacts:
        """Read what a study's stage `read`, or a saved result, keeps in its folder ``population``."""
        content, _ = load_artifact(folder, "facts")
        parts: dict[str, Any] = {part: tuple(EpisodeKey(*row) for row in content[part]) for part in _PARTS}
        known = content.get("digests", {})
        pairs = [pair for part, keys in parts.items() for pair in zip(keys, known.get(part, ()), strict=False)]
        limits = content.get("limits", {})
        return cls(
            identify_on=content["identify_on"],
            groups=content["groups"],
            resolution=content["resolution"],
            limits={name: FoundLimit(**{**of, "units": tuple(of["units"])}) for name, of in limits.items()},
            digests={key: digest for key, digest in pairs if digest},
            **parts,
            **{name: tuple(content.get(name, ())) for name in _TEXTS},
        )


@dataclass(frozen=True)
class _Group:
    """One unit in one condition, for a worker; `folder` is None where the recordings stay where they are."""

    population: Population
    folder: Path | None
    on_nan: str


@dataclass(frozen=True)
class _GroupFacts:
    """What a worker read in one unit and condition; `written` is the digest of the file that it wrote."""

    record: GroupRecord | None
    written: str | None
    resolution: dict[str, float]
    scanned: list[tuple[EpisodeKey, str]]
    alerts: tuple[str, ...]
    ends: dict[str, list[Ends]]
    inputs: list[Array]  # lowest and highest inputs of every episode, shape (2, m)
    sizes: list[Array]  # of the channels of every episode, with its number of samples behind them


_KINDS = (_GroupFacts, GroupRecord, EpisodeKey, FlatTops)


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
    tasks = [_Group(population.select([u], [c]), folder, chosen.on_nan) for u, c, _ in population.groups()]
    keys = (keys for _, _, keys in population.groups())
    marks = recording_marks(population.source, keys, chosen.on_nan, folder is None)

    def usable(task: _Group, known: _GroupFacts) -> bool:
        return copy is None or copy.reuse(known)

    groups = list((work or Work()).recall("read", _read_group, tasks, marks, _KINDS, usable))
    retained = _retained(population, groups, folder)
    part = [group for group in groups if group.scanned[0][0].unit not in set(chosen.reserve)]
    facts = _facts(population, retained, part, chosen)
    for name, limit in facts.limits.items():
        log.info("%s is limited at %s.", name, limit)
    for alert in facts.alerts:
        log.warning("%s", alert)
    return retained, facts


def _facts(
    population: Population, retained: Population, groups: Sequence[_GroupFacts], options: SurveyOptions
) -> RecordingFacts:
    """Return the facts of all groups that take part."""
    left, part = set(retained.episodes), [u for u in retained.unit_ids if u not in set(options.reserve)]
    splits = split_episodes(retained.select(part), options.test)
    sizes = {key: size for g in groups for (key, _), size in zip(g.scanned, g.sizes, strict=True)}
    short = [f"{title(key)} has {int(size[-1])}" for key, size in sizes.items() if size[-1] < options.fewest]
    if short:
        needs = f"every episode needs at least {options.fewest} samples after preparation"
        raise DataError(f"Recordings: {needs}; {some(short)}. Leave short episodes out, or record longer.")
    alerts = [alert for g in groups for alert in g.alerts] + list(scale_alerts(sizes, population.columns))
    outliers = {u for u in part if retained.unit(u).group == OUTLIERS}
    return RecordingFacts(
        identify_on=condition_of(population.select(part), options.identify_on),
        groups={unit: retained.unit(unit).group for unit in part},
        train=tuple(k for s in splits.values() for k in s.train),
        test=tuple(k for s in splits.values() for k in s.test),
        resolution={m: min(g.resolution[m] for g in groups) for m in retained.measured},
        dropped=tuple(str(k) for k in population.episodes if k not in left),
        alerts=tuple(dict.fromkeys(alerts)),
        reserve=tuple(options.reserve),
        limits=_limits([g for g in groups if g.scanned[0][0].unit not in outliers]),
        digests=dict(pair for g in groups for pair in g.scanned),
    )


def check_usable(
    population: Population, test: Iterable[str] | None, identify_on: str | None, single_allowed: bool
) -> None:
    """Refuse what can be refused from names alone, before anything is read or written."""
    check_population(population, allow_single=single_allowed)
    split_episodes(population, test)
    condition_of(population, identify_on)


def condition_of(population: Population, wanted: str | None) -> str:
    """Return the condition whose models feed synthesis: the one named, else that without load, else the first."""
    conditions = population.conditions
    if wanted is None:
        return UNLOADED if UNLOADED in conditions else next(iter(conditions), DEFAULT_CONDITION)
    if wanted not in conditions:
        known = f"the recordings have the conditions {', '.join(conditions)}"
        raise DataError(f"data.identify_on = {wanted!r}: {known}; name one of them.")
    return wanted


def _read_group(task: _Group) -> _GroupFacts:
    """Read, check and, where asked, write one unit and condition."""
    population, record, written = task.population, None, None
    ((unit, condition, _),) = population.groups()
    names, n = [c.name for c in population.channels], len(population.states)
    ends: dict[str, list[Ends]] = {name: [] for name in population.states if name not in population.measured}
    first: list[Array] = []
    sizes: list[Array] = []
    reach: list[Array] = []

    def look(key: EpisodeKey, values: Array) -> None:
        first.extend([values] if not first else [])
        sizes.append(np.append(size_of(values), len(values)))
        inputs = values[:, n : len(names)]
        reach.append(np.stack([inputs.min(axis=0), inputs.max(axis=0)]))
        for name, of in ends.items():
            of.append(ends_of(unit, f"{condition}/{key.episode}", values[:, names.index(name)], inputs))

    if task.folder is None:
        digests = scan_digests(population, on_nan=task.on_nan, look=look)
    else:
        record = write_group(population, unit, condition, task.folder, task.on_nan, look)
        digests = record.recognised
    if not digests:
        raise DataError(f"Unit {unit} ({condition}): every episode was dropped; fix the source or leave the unit out.")
    if record is not None and task.folder is not None:
        written = file_digest(task.folder / record.file)
    resolution = {name: smallest_step(first[0][:, names.index(name)]) for name in population.measured}
    alerts = period_alerts(first[0][:, : len(names)], population.channels, population.sample_period_s)
    return _GroupFacts(record, written, resolution, digests, alerts, ends, reach, sizes)


def _limits(groups: Sequence[_GroupFacts]) -> dict[str, FoundLimit]:
    """Return the limits that the states of all units were seen at."""
    if not groups:
        return {}
    reach = np.concatenate([inputs for group in groups for inputs in group.inputs])
    ranges, names = np.ptp(reach, axis=0), groups[0].ends
    limits = {name: found_limit([e for g in groups for e in g.ends[name]], ranges) for name in names}
    return {name: limit for name, limit in limits.items() if limit is not None}


def _retained(population: Population, groups: Sequence[_GroupFacts], folder: Path | None) -> Population:
    """Return the population of usable episodes, that of the copy where there is one."""
    if folder is not None:
        write_index(population, [g.record for g in groups if g.record is not None], folder, converted=False)
        return read_parquet(folder)
    scanned = [pair for group in groups for pair in group.scanned]
    refuse_copies(scanned)
    present = {key for key, _ in scanned}
    return replace(population, episodes=tuple(k for k in population.episodes if k in present))
