"""One pass over all recordings: every episode read and checked once, and split into training and test.

Population --survey--> Population that can be used, RecordingFacts
"""

from __future__ import annotations

import logging
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from functools import cached_property
from hashlib import sha256
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from ..core.artifacts import load_artifact, loader
from ..core.errors import DataError
from ..core.files import is_file
from ..core.work import Work
from .alerts import period_alerts, scale_alerts, size_of
from .checks import check_population, refuse_copies, scan_digests
from .flat_tops import Ends, FlatTops, FoundLimit, ends_of, found_limit
from .population import DEFAULT_CONDITION, OUTLIERS, EpisodeKey, Population, split_episodes
from .prepare import recording_marks
from .recording import some, title
from .writers.folders import same_file
from .writers.parquet import GroupRecord, write_group, write_index

Array = npt.NDArray[np.float64]
log = logging.getLogger(__name__)
UNLOADED = "noload"
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
        keys: Sequence[EpisodeKey] = getattr(self, part) if unit is None else self._by_unit[part].get(unit, ())
        return tuple(k for k in keys if condition in (None, k.condition))

    @cached_property
    def _by_unit(self) -> dict[str, dict[str, list[EpisodeKey]]]:
        """Episodes of every part and unit."""
        parts: dict[str, dict[str, list[EpisodeKey]]] = {"train": {}, "test": {}}
        for part, units in parts.items():
            for key in getattr(self, part):
                units.setdefault(key.unit, []).append(key)
        return parts

    def marks(self, keys: Iterable[EpisodeKey]) -> tuple[str, ...] | None:
        """Return what some episodes are known again by; None where it is not known of one of them."""
        digests = tuple(self.digests.get(key, "") for key in keys)
        return digests if all(digests) else None

    def content(self) -> dict[str, Any]:
        """Return the facts in JSON's types."""
        parts = {part: getattr(self, part) for part in ("train", "test")}
        rows = {part: [[k.unit, k.condition, k.episode] for k in keys] for part, keys in parts.items()}
        facts = {name: getattr(self, name) for name in ("identify_on", "groups", "resolution", *_TEXTS)}
        limits = {name: asdict(limit) for name, limit in self.limits.items()}
        digests = {part: [self.digests.get(k) for k in keys] for part, keys in parts.items()}
        return facts | rows | {"limits": limits} | ({"digests": digests} if self.digests else {})

    @classmethod
    @loader
    def load(cls, folder: Path) -> RecordingFacts:
        """Read what a study's stage `read`, or a saved result, keeps in its folder ``population``."""
        content, _ = load_artifact(folder, "facts")
        parts: dict[str, Any] = {part: tuple(EpisodeKey(*row) for row in content[part]) for part in ("train", "test")}
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
    unit: str
    condition: str
    folder: Path | None
    on_nan: str


@dataclass(frozen=True)
class _Found:
    """What a worker read in one unit and condition; `written` is the digest of the file that it wrote."""

    record: GroupRecord | None
    written: str | None
    resolution: dict[str, float]
    scanned: list[tuple[EpisodeKey, str]]
    alerts: tuple[str, ...]
    ends: dict[str, list[Ends]]
    inputs: Array
    sizes: list[Array]  # of the channels of every episode, with its number of samples behind them


_KINDS = (_Found, GroupRecord, EpisodeKey, Ends, FlatTops)


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


def survey(
    population: Population, work: Work | None = None, copy: Copy | None = None, **options: Any
) -> tuple[Population, RecordingFacts]:
    """Read all recordings once, without those that `work` knows from earlier, with options of `SurveyOptions`."""
    chosen = SurveyOptions(**options)
    folder = None if copy is None else copy.folder
    if folder is not None:
        folder.mkdir(parents=True)
    tasks = [_Group(population.select([u], [c]), u, c, folder, chosen.on_nan) for u, c, _ in population.groups()]
    keys = (keys for _, _, keys in population.groups())
    marks = recording_marks(population.source, keys, chosen.on_nan, folder is None)

    def usable(task: _Group, known: _Found) -> bool:
        return copy is None or _taken(known, copy)

    found = list((work or Work()).recall("read", _read_group, tasks, marks, _KINDS, usable))
    retained = _retained(population, found, folder)
    part = [f for task, f in zip(tasks, found, strict=True) if task.unit not in set(chosen.reserve)]
    facts = _facts(population, retained, part, chosen)
    for name, limit in facts.limits.items():
        log.info("%s is limited at %s.", name, limit)
    for alert in facts.alerts:
        log.warning("%s", alert)
    return retained, facts


def _facts(
    population: Population, retained: Population, found: Sequence[_Found], options: SurveyOptions
) -> RecordingFacts:
    """Return what all groups that take part tell together."""
    left, part = set(retained.episodes), [u for u in retained.unit_ids if u not in set(options.reserve)]
    splits = split_episodes(retained.select(part), options.test)
    sizes = {key: size for f in found for (key, _), size in zip(f.scanned, f.sizes, strict=True)}
    short = [f"{title(key)} has {int(size[-1])}" for key, size in sizes.items() if size[-1] < options.fewest]
    if short:
        needs = f"every episode needs at least {options.fewest} samples after preparation"
        raise DataError(f"Recordings: {needs}; {some(short)}. Leave short episodes out, or record longer.")
    alerts = [alert for f in found for alert in f.alerts] + list(scale_alerts(sizes, population.columns))
    outliers = {u for u in part if retained.unit(u).group == OUTLIERS}
    return RecordingFacts(
        identify_on=condition_of(population.select(part), options.identify_on),
        groups={unit: retained.unit(unit).group for unit in part},
        train=tuple(k for s in splits.values() for k in s.train),
        test=tuple(k for s in splits.values() for k in s.test),
        resolution={m: min(f.resolution[m] for f in found) for m in retained.measured},
        dropped=tuple(str(k) for k in population.episodes if k not in left),
        alerts=tuple(dict.fromkeys(alerts)),
        reserve=tuple(options.reserve),
        limits=_limits([f for f in found if f.scanned[0][0].unit not in outliers]),
        digests=dict(pair for f in found for pair in f.scanned),
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


def _read_group(task: _Group) -> _Found:
    """Read, check and, where asked, write one unit and condition."""
    population, record = task.population, None
    names, inputs = [c.name for c in population.channels], slice(len(population.states), len(population.channels))
    ends: dict[str, list[Ends]] = {name: [] for name in population.states if name not in population.measured}
    reach = np.array([[np.inf], [-np.inf]]) * np.ones(len(population.inputs))
    first: list[Array] = []
    sizes: list[Array] = []

    def look(key: EpisodeKey, values: Array) -> None:
        if not first:
            first.append(values)
        sizes.append(np.append(size_of(values), len(values)))
        columns = np.ascontiguousarray(values.T)
        for name, of in ends.items():
            signal = columns[names.index(name)]
            of.append(ends_of(key.unit, f"{key.condition}/{key.episode}", signal, columns[inputs].T))
        reach[0] = np.minimum(reach[0], columns[inputs].min(axis=1))
        reach[1] = np.maximum(reach[1], columns[inputs].max(axis=1))

    if task.folder is None:
        digests = scan_digests(population, on_nan=task.on_nan, look=look)
    else:
        record = write_group(population, task.unit, task.condition, task.folder, task.on_nan, look)
        digests, record = record.recognised, replace(record, digests=())
    if not digests:
        what = f"Unit {task.unit} ({task.condition}): every episode was dropped"
        raise DataError(f"{what}; fix the source or leave the unit out.")
    steps = {name: resolution(first[0][:, names.index(name)]) for name in population.measured}
    alerts = period_alerts(first[0][:, : len(names)], population.channels, population.sample_period_s)
    written = None if record is None or task.folder is None else _digest(task.folder / record.file)
    return _Found(record, written, steps, digests, alerts, ends, reach, sizes)


def _digest(path: Path) -> str:
    return sha256(path.read_bytes()).hexdigest()


def _taken(known: _Found, copy: Copy) -> bool:
    """Take the file of an earlier copy where it is as it was written; tell whether it was."""
    if known.record is None:
        return False
    path = copy.earlier / known.record.file
    if not is_file(path) or _digest(path) != known.written:
        return False
    same_file(path, copy.folder / known.record.file)
    return True


def _limits(found: Sequence[_Found]) -> dict[str, FoundLimit]:
    """Return the limits that the states of all units were seen at."""
    if not found:
        return {}
    ranges = np.max([f.inputs[1] for f in found], axis=0) - np.min([f.inputs[0] for f in found], axis=0)
    limits = {name: found_limit([end for f in found for end in f.ends[name]], ranges) for name in found[0].ends}
    return {name: limit for name, limit in limits.items() if limit is not None}


def _retained(population: Population, found: Sequence[_Found], folder: Path | None) -> Population:
    """Return the population of usable episodes, that of the copy where there is one."""
    if folder is not None:
        from .readers.parquet import read_parquet

        written = [(f.record, tuple(digest for _, digest in f.scanned)) for f in found]
        records = [replace(record, digests=digests) for record, digests in written if record is not None]
        write_index(population, records, folder, converted=False)
        return read_parquet(folder)
    scanned = [pair for f in found for pair in f.scanned]
    refuse_copies(scanned)
    present = {key for key, _ in scanned}
    return replace(population, episodes=tuple(k for k in population.episodes if k in present))


def resolution(signal: Array) -> float:
    """Return the smallest step between samples, the quantisation of a digital sensor."""
    steps = np.abs(np.diff(signal))
    floor = 1e-9 * np.max(np.abs(signal))
    return float(np.min(steps[steps > floor], initial=np.inf)) if np.any(steps > floor) else float(floor)
