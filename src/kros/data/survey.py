"""One pass over all recordings: every episode read and checked once, training and test told apart, and what later steps need to know.

Population --survey--> Population that can be used, RecordingFacts
"""

from __future__ import annotations

import logging
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from functools import cached_property
from hashlib import sha256
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from ..core.artifacts import load_artifact
from ..core.errors import DataError
from ..core.files import is_file
from ..core.loading import loader
from ..core.work import Work
from .alerts import period_alerts, scale_alerts, size_of
from .checks import check_population, scan_digests
from .copies import refuse_copies
from .flat_tops import Ends, FlatTops, FoundLimit, ends_of, found_limit
from .marks import recording_marks
from .population import DEFAULT_CONDITION, OUTLIERS, EpisodeKey, Population, split_episodes
from .recording import some, title
from .writers.folders import same_file
from .writers.parquet import GroupRecord, write_group, write_index

log = logging.getLogger(__name__)
UNLOADED = "noload"


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
    limits: Mapping[str, FoundLimit] = field(
        default_factory=dict
    )  # limits that states which are not measured were seen at
    digests: Mapping[EpisodeKey, str] = field(default_factory=dict)

    @cached_property
    def pooled(self) -> tuple[str, ...]:
        """Units that take part in pooled results."""
        return tuple(u for u, group in self.groups.items() if group != OUTLIERS)

    def keys(self, part: str, unit: str | None = None, condition: str | None = None) -> tuple[EpisodeKey, ...]:
        """Return the episodes of a part, ``train`` or ``test``, of a unit, a condition or both."""
        own: tuple[EpisodeKey, ...] = getattr(self, part) if unit is None else self._by_unit[part].get(unit, ())
        return own if condition is None else tuple(k for k in own if k.condition == condition)

    @cached_property
    def _by_unit(self) -> dict[str, dict[str, tuple[EpisodeKey, ...]]]:
        """Episodes of every part and unit: asking for one unit does not walk through those of all."""
        found: dict[str, dict[str, list[EpisodeKey]]] = {"train": {}, "test": {}}
        for part, units in found.items():
            for key in getattr(self, part):
                units.setdefault(key.unit, []).append(key)
        return {part: {unit: tuple(keys) for unit, keys in units.items()} for part, units in found.items()}

    def marks(self, keys: Iterable[EpisodeKey]) -> tuple[str, ...] | None:
        """Return what some episodes are known again by; None where it is not known of one of them."""
        found = tuple(self.digests.get(key) for key in keys)
        return None if None in found else tuple(str(digest) for digest in found)

    def content(self) -> dict[str, Any]:
        """Return the facts in JSON's types."""
        rows = {part: [[k.unit, k.condition, k.episode] for k in getattr(self, part)] for part in ("train", "test")}
        names = ("identify_on", "groups", "resolution", "dropped", "alerts", "reserve")
        limits = {name: asdict(limit) for name, limit in self.limits.items()}
        digests = {part: [self.digests.get(k) for k in getattr(self, part)] for part in rows} if self.digests else {}
        return (
            {name: getattr(self, name) for name in names}
            | rows
            | {"limits": limits}
            | ({"digests": digests} if digests else {})
        )

    @classmethod
    @loader
    def load(cls, folder: Path) -> RecordingFacts:
        """Read what a study's stage `read`, or a saved result, keeps in its folder ``population``."""
        content, _ = load_artifact(folder, "facts")
        train, test = (tuple(EpisodeKey(*row) for row in content[part]) for part in ("train", "test"))
        texts = {name: tuple(content.get(name, ())) for name in ("dropped", "alerts", "reserve")}
        limits = {
            name: FoundLimit(**{**own, "units": tuple(own["units"])}) for name, own in content.get("limits", {}).items()
        }
        known = content.get("digests", {})
        digests = {
            k: d
            for part, keys in (("train", train), ("test", test))
            for k, d in zip(keys, known.get(part, ()), strict=False)
            if d
        }
        return cls(
            content["identify_on"],
            content["groups"],
            train,
            test,
            content["resolution"],
            **texts,
            limits=limits,
            digests=digests,
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
    """What a worker found in one unit and condition; `written` is the digest of the file that it wrote."""

    record: GroupRecord | None
    written: str | None
    episodes: tuple[EpisodeKey, ...]
    resolution: dict[str, float]
    scanned: list[tuple[EpisodeKey, str]]
    alerts: tuple[str, ...]
    ends: dict[str, list[Ends]]
    inputs: npt.NDArray[np.float64]
    sizes: list[npt.NDArray[np.float64]]  # of the channels of every episode, with its number of samples behind them


_KINDS = (_Found, GroupRecord, EpisodeKey, Ends, FlatTops)


def survey(
    population: Population,
    test: Iterable[str] | None = None,
    identify_on: str | None = None,
    on_nan: str = "error",
    folder: Path | None = None,
    work: Work | None = None,
    reserve: Sequence[str] = (),
    earlier: Path | None = None,
    wrote: Callable[[Path, str], None] | None = None,
    fewest: int = 0,
) -> tuple[Population, RecordingFacts]:
    """Read all recordings once, without those that `work` knows from earlier; refuse episodes of less than `fewest` samples."""
    if folder is not None:
        folder.mkdir(parents=True)
    tasks = [_Group(population.select([u], [c]), u, c, folder, on_nan) for u, c, _ in population.groups()]
    marks = recording_marks(population.source, (keys for _, _, keys in population.groups()), on_nan, folder is None)

    def usable(task: _Group, known: _Found) -> bool:
        return folder is None or _taken(known, earlier, folder)

    found = list((work or Work()).recall("read", _read_group, tasks, marks, _KINDS, usable))
    if wrote is not None and folder is not None:
        for group in found:
            if group.record is not None and group.written is not None:
                wrote(folder / group.record.file, group.written)
    kept = _kept(population, found, folder)
    left, aside = set(kept.episodes), set(reserve)
    taking_part = [u for u in kept.unit_ids if u not in aside]
    own = [f for task, f in zip(tasks, found, strict=True) if task.unit not in aside]
    splits = split_episodes(kept.select(taking_part), test)
    sizes = {key: size for f in own for (key, _), size in zip(f.scanned, f.sizes, strict=True)}
    short = {key: int(size[-1]) for key, size in sizes.items() if size[-1] < fewest}
    if short:
        texts = [f"{title(key)} has {n}" for key, n in short.items()]
        raise DataError(
            f"Recordings: every episode needs at least {fewest} samples after preparation; {some(texts)}. Leave short episodes out, or record longer."
        )
    alerts = [alert for f in found for alert in f.alerts] + list(scale_alerts(sizes, population.columns))
    facts = RecordingFacts(
        identify_on=condition_of(population.select(taking_part), identify_on),
        groups={unit: kept.unit(unit).group for unit in taking_part},
        train=tuple(k for s in splits.values() for k in s.train),
        test=tuple(k for s in splits.values() for k in s.test),
        resolution={m: min(f.resolution[m] for f in own) for m in kept.measured},
        dropped=tuple(str(k) for k in population.episodes if k not in left),
        alerts=tuple(dict.fromkeys(alerts)),
        reserve=tuple(reserve),
        limits=_limits(
            [
                f
                for task, f in zip(tasks, found, strict=True)
                if task.unit not in aside and kept.unit(task.unit).group != OUTLIERS
            ]
        ),
        digests=dict(pair for f in own for pair in f.scanned),
    )
    for name, limit in facts.limits.items():
        log.info("%s is limited at %s.", name, limit)
    for alert in facts.alerts:
        log.warning("%s", alert)
    return kept, facts


def check_usable(
    population: Population, test: Iterable[str] | None, identify_on: str | None, single_allowed: bool
) -> None:
    """Refuse what can be refused from names alone, before anything is read or written."""
    check_population(population, allow_single=single_allowed)
    split_episodes(population, test)
    condition_of(population, identify_on)
    if not population.measured:
        raise DataError(
            f"No channel is measured: an observer needs a state that is available at run time, found states {', '.join(population.states)}; "
            "declare measured = true for at least one."
        )


def condition_of(population: Population, wanted: str | None) -> str:
    """Return the condition whose models feed synthesis: the one asked for, else that without load, else the first."""
    conditions = population.conditions
    if wanted is None:
        return UNLOADED if UNLOADED in conditions else (conditions[0] if conditions else DEFAULT_CONDITION)
    if wanted not in conditions:
        raise DataError(
            f"data.identify_on = {wanted!r}: the recordings have the conditions {', '.join(conditions)}; name one of them."
        )
    return wanted


def _read_group(task: _Group) -> _Found:
    """Read, check and, where asked, write one unit and condition."""
    population, record = task.population, None
    own, hidden = (
        slice(len(population.states), len(population.states) + len(population.inputs)),
        [name for name in population.states if name not in population.measured],
    )
    ends: dict[str, list[Ends]] = {name: [] for name in hidden}
    reach = np.array([[np.inf], [-np.inf]]) * np.ones(len(population.inputs))
    shown: list[npt.NDArray[np.float64]] = []
    sizes: list[npt.NDArray[np.float64]] = []

    def look(key: EpisodeKey, values: npt.NDArray[np.float64]) -> None:
        if not shown:
            shown.append(values)
        sizes.append(np.append(size_of(values), len(values)))
        columns = np.ascontiguousarray(values.T)
        for name in hidden:
            signal = columns[population.states.index(name)]
            ends[name].append(ends_of(key.unit, f"{key.condition}/{key.episode}", signal, columns[own].T))
        reach[:] = np.minimum(reach[0], columns[own].min(axis=1)), np.maximum(reach[1], columns[own].max(axis=1))

    if task.folder is None:
        digests = scan_digests(population.select([task.unit], [task.condition]), on_nan=task.on_nan, look=look)
    else:
        record = write_group(population, task.unit, task.condition, task.folder, task.on_nan, look)
        digests, record = record.recognised, replace(record, digests=())
    episodes = tuple(key for key, _ in digests)
    if not episodes:
        raise DataError(
            f"Unit {task.unit} ({task.condition}): every episode was dropped; fix the source or leave the unit out."
        )
    first = shown[0][:, : len(population.channels)]
    names = population.states + population.inputs
    steps = {m: resolution(first[:, names.index(m)]) for m in population.measured}
    alerts = period_alerts(first, population.channels, population.sample_period_s)
    written = None if record is None or task.folder is None else _digest(task.folder / record.file)
    return _Found(record, written, episodes, steps, digests, alerts, ends, reach, sizes)


def _digest(path: Path) -> str:
    return sha256(path.read_bytes()).hexdigest()


def _taken(known: _Found, earlier: Path | None, folder: Path) -> bool:
    """Take the file of recordings that are known from an earlier folder, where it is as it was written; tell whether it was."""
    if earlier is None or known.record is None:
        return False
    path = earlier / known.record.file
    if not is_file(path) or _digest(path) != known.written:
        return False
    same_file(path, folder / known.record.file)
    return True


def _limits(found: Sequence[_Found]) -> dict[str, FoundLimit]:
    """Return the limits that the states of all units were seen at."""
    if not found:
        return {}
    ranges = np.max([f.inputs[1] for f in found], axis=0) - np.min([f.inputs[0] for f in found], axis=0)
    limits = {name: found_limit([end for f in found for end in f.ends[name]], ranges) for name in found[0].ends}
    return {name: limit for name, limit in limits.items() if limit is not None}


def _kept(population: Population, found: Sequence[_Found], folder: Path | None) -> Population:
    if folder is not None:
        from .readers.parquet import read_parquet

        records = [
            replace(f.record, digests=tuple(digest for _, digest in f.scanned)) for f in found if f.record is not None
        ]
        write_index(population, records, folder, converted=False)
        return read_parquet(folder)
    refuse_copies(pair for f in found for pair in f.scanned)
    present = {key for f in found for key in f.episodes}
    if len(present) == len(population.episodes):
        return population
    return replace(population, episodes=tuple(k for k in population.episodes if k in present))


def resolution(signal: npt.NDArray[np.float64]) -> float:
    """Return the smallest step between samples, the quantisation of a digital sensor."""
    steps = np.abs(np.diff(signal))
    floor = 1e-9 * np.max(np.abs(signal))
    return float(steps[steps > floor].min()) if np.any(steps > floor) else float(floor)
