"""`kros estimate`: estimates beside what was recorded, with time, status and error band, in the recordings' units."""

from collections import Counter, defaultdict
from collections.abc import Collection
from pathlib import Path

import numpy as np

from ...core import ConfigError, Record
from ...data import EpisodeKey
from ...export.estimates import ENDINGS, writer
from ...observer import recorded_channel, recorded_factors
from ..engine.context import open_finished
from .field import FieldRecordings, status_counts


def estimate_recordings(
    run: Path, data: Path, out: Path, given: Collection[str] = (), track: str | None = None
) -> list[str]:
    """Write what `facts_of` names for every sample; return what people read.

    The band is the bound of the RMS error for recorded signals, where the observer has one and the sample is good, and
    so were `settle_samples` before it.
    """
    with open_finished(run) as context:
        if out.exists() or out.suffix not in ENDINGS:
            raise ConfigError(f"Output {out}: should be a new file that ends in {' or '.join(ENDINGS)}.")
        recordings = FieldRecordings.open(context, data, given, track)
        observer, population = recordings.observer, recordings.population
        names = observer.recorded
        stated = context.observers_record["facts"].get(observer.name, {})
        bound = np.array([stated.get("set_bound", {}).get(name) for name in names], dtype=float)
        factors = recorded_factors(observer, [*(c.name for c in population.channels), *names])
        counts, n = defaultdict[str, Counter[str]](Counter), len(names)
        settle, latest = stated.get("settle_samples", 0), dict[EpisodeKey, float]()  # samples that are not good
        with writer(out, population.sample_period_s, facts_of(recordings)) as write:
            for key, start, columns, status, recorded in recordings.estimates():
                k = np.arange(start, start + len(status))
                disturbed = np.where(status != 0, k, latest.get(key, -np.inf))
                settled = k - np.maximum.accumulate(disturbed) > settle
                latest[key] = disturbed.max()
                band = np.where(settled[:, None], bound / np.abs(factors[-n:]), np.nan)
                values = np.hstack([np.hstack([recorded, columns[:, :n]]) / factors, band, columns[:, n:]])
                write(key, start, status, values)
                counts[key.unit].update(status_counts(status))
    count = len(population.episodes)
    lines = [f"estimates of {count} episode{'s' * (count != 1)} in {out}"]
    for unit in population.unit_ids:
        parts = [f"parameters {recordings.sources[unit]}"] if unit in recordings.sources else []
        parts += [f"{count} samples {bit}" for bit, count in counts[unit].items()]
        lines += [f"  unit {unit}: {'; '.join(parts)}"] if parts else []
    return lines


def facts_of(recordings: FieldRecordings) -> Record:
    """Return the observer, columns with their units of measure, and parameters of every unit with their sources."""
    observer, name = recordings.observer, recordings.name
    columns = {c.name: recorded_channel(observer, c.name).unit for c in recordings.population.channels}
    for ending in ("hat", "band"):
        columns |= {f"{state}_{ending}": recorded_channel(observer, state).unit for state in observer.recorded}
    columns |= {name: "rad"} if name else {}
    parameters = {u: {**recordings.values[u], "source": source} for u, source in recordings.sources.items()}
    about = {key: observer.about.get(key) for key in ("kros", "study")}
    return {"observer": observer.name, **about, "columns": columns, "parameters": parameters}
