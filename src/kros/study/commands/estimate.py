"""Estimates of the deployed observer on recordings, as Parquet or CSV; measured channels and inputs are enough.

Estimates are in the units of the recordings that the study read, as those of an exported observer.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Collection, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from ...core.artifacts import write_json
from ...core.errors import ConfigError
from ...data.population import EpisodeKey
from ...observer.units import recorded_channel, recorded_factors
from ..config import Stage
from ..engine.run_folder import open_finished
from .field import FieldRecordings, count_status

Array = npt.NDArray[np.float64]
Write = Callable[[EpisodeKey, int, Array], None]
ENDINGS = (".parquet", ".csv")
KEYS = ("unit", "condition", "episode", "k")


def estimate_recordings(
    run: Path, data: Path, out: Path, given: Collection[str] = (), track: str | None = None
) -> list[str]:
    """Write ``unit, condition, episode, k, <channel>_hat`` for every sample, then the parameter that is followed.

    Return what people read at the terminal.
    """
    with open_finished(run, Stage.READ, Stage.CALIBRATE, Stage.SYNTHESIZE) as (config, store):
        if out.exists() or out.suffix not in ENDINGS:
            raise ConfigError(f"Output {out}: should be a new file that ends in {' or '.join(ENDINGS)}.")
        recordings = FieldRecordings.open(config, store, data, given, track)
        counts: dict[str, dict[str, int]] = {}
        with writer(out, facts_of(recordings)) as write:
            factors = recorded_factors(recordings.observer, recordings.observer.recorded)
            for key, start, columns, status in recordings.estimates():
                columns[:, : len(factors)] /= factors
                write(key, start, columns)
                count_status(counts.setdefault(key.unit, {}), status)
    count = len(recordings.population.episodes)
    return [f"estimates of {count} episode{'s' * (count != 1)} in {out}", *unit_lines(recordings.sources, counts)]


def unit_lines(sources: Mapping[str, str], counts: Mapping[str, Mapping[str, int]]) -> list[str]:
    """Return a line a unit with the source of its parameters and its samples by status, where there is any."""
    lines = []
    for unit in dict.fromkeys([*sources, *(u for u, of_unit in counts.items() if of_unit)]):
        parts = [f"parameters {sources[unit]}"] if unit in sources else []
        parts += [f"{count} samples {bit}" for bit, count in counts.get(unit, {}).items()]
        lines.append(f"  unit {unit}: {'; '.join(parts)}")
    return lines


def facts_of(recordings: FieldRecordings) -> dict[str, Any]:
    """Return the observer, columns with their units of measure, and parameters of every unit with their sources."""
    observer, name = recordings.observer, recordings.name
    columns = {f"{s}_hat": recorded_channel(observer, s).unit for s in observer.recorded}
    columns |= {} if name is None else {name: "rad"}
    parameters = {u: {**recordings.values[u], "source": source} for u, source in recordings.sources.items()}
    about = {key: observer.about.get(key) for key in ("kros", "study")}
    return {"observer": observer.name, **about, "columns": columns, "parameters": parameters}


@contextmanager
def writer(out: Path, facts: dict[str, Any]) -> Iterator[Write]:
    """Give a function that writes an episode's estimates from a sample on; the file appears whole or not at all."""
    out.parent.mkdir(parents=True, exist_ok=True)
    temporary = out.with_name(f".{out.name}.partial")
    try:
        with (_csv if out.suffix == ".csv" else _parquet)(temporary, facts) as write:
            yield write
        if out.suffix == ".csv":
            write_json(out.with_name(f"{out.name}-metadata.json"), facts)
        temporary.replace(out)
    finally:
        temporary.unlink(missing_ok=True)


@contextmanager
def _csv(path: Path, facts: dict[str, Any]) -> Iterator[Write]:
    import csv

    with path.open("w", newline="") as file:
        rows = csv.writer(file)
        rows.writerow([*KEYS, *facts["columns"]])
        yield lambda key, start, values: rows.writerows(
            [key.unit, key.condition, key.episode, k, *map(repr, row)] for k, row in enumerate(values.tolist(), start)
        )


@contextmanager
def _parquet(path: Path, facts: dict[str, Any]) -> Iterator[Write]:
    import pyarrow as pa
    from pyarrow import parquet

    text = pa.dictionary(pa.int32(), pa.string())
    columns = [
        pa.field(name, pa.float64(), metadata={"unit": unit} if unit else None)
        for name, unit in facts["columns"].items()
    ]
    labels = [pa.field(name, pa.int64() if name == "k" else text) for name in KEYS]
    metadata = {
        name: value if isinstance(value, str) else json.dumps(value)
        for name, value in facts.items()
        if value is not None
    }
    schema = pa.schema([*labels, *columns], metadata=metadata)
    with parquet.ParquetWriter(path, schema, write_page_checksum=True) as file:

        def write(key: EpisodeKey, start: int, values: Array) -> None:
            zeros = pa.array(np.zeros(len(values), np.int32))
            labelled = [
                pa.DictionaryArray.from_arrays(zeros, pa.array([t])) for t in (key.unit, key.condition, key.episode)
            ]
            numbers = [pa.array(np.ascontiguousarray(column)) for column in values.T]
            samples = pa.array(np.arange(start, start + len(values)))
            table = pa.Table.from_arrays([*labelled, samples, *numbers], schema=schema)
            file.write_table(table, row_group_size=max(len(table), 1))

        yield write
