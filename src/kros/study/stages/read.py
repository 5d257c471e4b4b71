"""Stage: read, prepare and check all recordings; what is not kros's own format yet is written to the run folder in it."""

from __future__ import annotations

import logging
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import numpy.typing as npt

from ...core.artifacts import save_artifact
from ...core.errors import ConfigError, DataError
from ...data import (
    EpisodeKey,
    Population,
    check_population,
    read,
    read_parquet,
    split_episodes,
    write_group,
    write_index,
)
from ...data.alerts import period_alerts
from ...data.checks import scan_prints
from ...data.copies import Print, refuse_copies
from ...data.population import DEFAULT_CONDITION
from ...data.writers import GroupRecord
from ..config import StudyConfig
from ..engine.context import Context
from ..presets import resolve_lifting, resolve_phase

log = logging.getLogger(__name__)
PARQUET = "parquet"


@dataclass(frozen=True)
class GroupTask:
    """One unit in one condition, for a worker; `folder` is None where the recordings stay where they are."""

    population: Population
    unit: str
    condition: str
    folder: Path | None
    on_nan: str


@dataclass(frozen=True)
class GroupFacts:
    """What a worker found in one unit and condition."""

    unit: str
    condition: str
    record: GroupRecord | None
    episodes: tuple[str, ...]
    resolution: dict[str, float]
    prints: list[tuple[EpisodeKey, Print]]
    alerts: tuple[str, ...]


def open_source(config: StudyConfig) -> Population:
    """Open the study's recordings, lazily, without the units that are excluded."""
    data = config.data
    population = read(data.source, data.reader, prepare=data.prepare, mapping=data.csv)
    unknown = [unit for unit in data.exclude if unit not in population.unit_ids]
    if unknown:
        raise ConfigError(f"data.exclude: the recordings have no unit {', '.join(unknown)}, only {', '.join(population.unit_ids)}.")
    return population.select([u for u in population.unit_ids if u not in data.exclude])


def check_source(config: StudyConfig, single_allowed: bool) -> None:
    """Refuse what can be refused from names alone, before anything is written."""
    population = open_source(config)
    check_population(population, allow_single=single_allowed)
    split_episodes(population, config.split.test)
    _identify_on(config, population)
    resolve_phase(config, population, resolve_lifting(config, population))
    if not population.measured:
        raise DataError(
            f"No channel is measured: an observer needs a state that is available at run time, found states {', '.join(population.states)}; "
            "declare measured = true for at least one."
        )
    hidden = [name for name in population.states if name not in population.measured]
    if unknown := sorted(set(config.predictor.importance) - set(hidden)):
        raise ConfigError(
            f"predictor.importance: {', '.join(unknown)} should be among the states that are not measured, {', '.join(hidden)}."
        )


def read_group(task: GroupTask) -> GroupFacts:
    """Read, check and, where asked, write one unit and condition."""
    if task.folder is None:
        prints = scan_prints(task.population.select([task.unit], [task.condition]), on_nan=task.on_nan)
        record = None
    else:
        record = write_group(task.population, task.unit, task.condition, task.folder, task.on_nan)
        prints = record.recognised
    population, episodes = task.population, tuple(key.episode for key, _ in prints)
    if not episodes:
        raise DataError(f"Unit {task.unit} ({task.condition}): every episode was dropped; fix the source or leave the unit out.")
    first = population.read(EpisodeKey(task.unit, task.condition, episodes[0]))
    names = population.states + population.inputs
    steps = {m: resolution(first[:, names.index(m)]) for m in population.measured}
    alerts = period_alerts(first, population.channels, population.sample_period_s)
    return GroupFacts(task.unit, task.condition, record, episodes, steps, prints, alerts)


def resolution(signal: npt.NDArray[np.float64]) -> float:
    """Return the smallest step between samples, the quantisation of a digital sensor."""
    steps = np.abs(np.diff(signal))
    floor = 1e-9 * np.max(np.abs(signal))
    return float(steps[steps > floor].min()) if np.any(steps > floor) else float(floor)


def run(context: Context) -> None:
    """Read everything once."""
    config, population = context.config, open_source(context.config)
    in_place = config.data.reader == PARQUET and not config.data.prepare
    folder = None if in_place else context.store.draft("recordings")
    if folder is not None:
        folder.mkdir(parents=True)
    tasks = [GroupTask(population.select([u], [c]), u, c, folder, config.data.on_nan) for u, c, _ in population.groups()]
    found = list(context.work.map("read", read_group, tasks))
    if folder is not None:
        records = [f.record for f in found if f.record is not None]
        write_index(population, records, folder)
        kept = read_parquet(folder)
    else:
        refuse_copies(pair for f in found for pair in f.prints)
        present = {(f.unit, f.condition, e) for f in found for e in f.episodes}
        kept = population
        if any((k.unit, k.condition, k.episode) not in present for k in population.episodes):
            raise DataError("Dropping episodes needs a copy of the recordings; convert them first with on_nan = 'drop_episode'.")
    save_facts(context, kept, found, population)


def save_facts(context: Context, kept: Population, found: list[GroupFacts], asked: Population) -> None:
    """Write what all later stages need to know about the recordings."""
    splits = split_episodes(kept, context.config.split.test)
    steps = {m: min(f.resolution[m] for f in found) for m in kept.measured}
    alerts = list(dict.fromkeys(alert for f in found for alert in f.alerts))
    for alert in alerts:
        log.warning("%s", alert)
    content = {
        "recordings": "recordings" if kept is not asked else context.config.data.source,
        "identify_on": _identify_on(context.config, kept),
        "groups": {u.id: u.group for u in kept.units},
        "train": [[k.unit, k.condition, k.episode] for s in splits.values() for k in s.train],
        "test": [[k.unit, k.condition, k.episode] for s in splits.values() for k in s.test],
        "resolution": steps,
        "alerts": alerts,
        "dropped": [str(k) for k in asked.episodes if k not in set(kept.episodes)],
    }
    save_artifact(context.store.draft("population"), "facts", content)


def _identify_on(config: StudyConfig, population: Population) -> str:
    wanted = config.data.identify_on
    if wanted is None:
        return "noload" if "noload" in population.conditions else (population.conditions[0] if population.conditions else DEFAULT_CONDITION)
    if wanted not in population.conditions:
        raise DataError(
            f"data.identify_on = {wanted!r}: the recordings have the conditions {', '.join(population.conditions)}; name one of them."
        )
    return wanted
