"""Estimates of the deployed observer on recordings, as Parquet or CSV; measured channels and inputs are enough.

Estimates are in the units of the recordings that the study read, as those of an exported observer.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Collection, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
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
from .field import FieldRecordings

Array = npt.NDArray[np.float64]
Write = Callable[[EpisodeKey, Array], None]
ENDINGS = (".parquet", ".csv")
KEYS = ("unit", "condition", "episode", "k")


@dataclass(frozen=True)
class Estimated:
    """What was written: episodes, sources of every unit's parameters, and its samples by bit of the status."""

    episodes: int
    parameters: dict[str, str]
    samples: dict[str, dict[str, int]] = field(default_factory=dict)

    def lines(self) -> list[str]:
        """Return it for people at a terminal, a line a unit where there is anything to say."""
        units, lines = dict.fromkeys([*self.parameters, *(u for u, counts in self.samples.items() if counts)]), []
        for unit in units:
            parts = [f"parameters {self.parameters[unit]}"] if unit in self.parameters else []
            parts += [f"{count} samples {bit}" for bit, count in self.samples.get(unit, {}).items()]
            lines.append(f"unit {unit}: {'; '.join(parts)}")
        return lines


def estimate_recordings(
    run: Path, data: Path, out: Path, given: Collection[str] = (), track: str | None = None
) -> Estimated:
    """Write ``unit, condition, episode, k, <channel>_hat`` for every sample, then the parameter that is followed."""
    with open_finished(run, Stage.READ, Stage.CALIBRATE, Stage.SYNTHESIZE) as (config, store):
        if out.exists() or out.suffix not in ENDINGS:
            raise ConfigError(f"Output {out}: should be a new file that ends in {' or '.join(ENDINGS)}.")
        recordings = FieldRecordings.open(config, store, data, given, track)
        samples: dict[str, dict[str, int]] = {}
        with writer(out, facts_of(recordings)) as write:
            for found in recordings.batches():
                estimates, followed, status = recordings.estimates(found)
                estimates /= recorded_factors(recordings.observer, recordings.observer.recorded)
                columns = estimates if followed is None else np.concatenate([estimates, followed[..., None]], axis=-1)
                for i, key in enumerate(found.batch.keys):
                    write(key, columns[: found.batch.lengths[i], i])
                recordings.count_status(found, samples, status)
    return Estimated(len(recordings.population.episodes), recordings.sources, samples)


def facts_of(recordings: FieldRecordings) -> dict[str, Any]:
    """Return the observer, columns with their units of measure, and parameters of every unit with their sources."""
    observer = recordings.observer
    name = recordings.name
    columns = {f"{s}_hat": recorded_channel(observer, s).unit for s in observer.recorded} | (
        {} if name is None else {name: "rad"}
    )
    parameters = {u: {**recordings.values[u], "source": source} for u, source in recordings.sources.items()}
    about = {key: observer.about.get(key) for key in ("kros", "study")}
    return {"observer": observer.name, **about, "columns": columns, "parameters": parameters}


@contextmanager
def writer(out: Path, facts: dict[str, Any]) -> Iterator[Write]:
    """Give a function that writes one episode's estimates; the file appears whole or not at all."""
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
        yield lambda key, values: rows.writerows(
            [key.unit, key.condition, key.episode, k, *(repr(v) for v in row)] for k, row in enumerate(values.tolist())
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

        def write(key: EpisodeKey, values: Array) -> None:
            zeros = pa.array(np.zeros(len(values), np.int32))
            labelled = [
                pa.DictionaryArray.from_arrays(zeros, pa.array([t])) for t in (key.unit, key.condition, key.episode)
            ]
            numbers = [pa.array(np.ascontiguousarray(column)) for column in values.T]
            table = pa.Table.from_arrays([*labelled, pa.array(np.arange(len(values))), *numbers], schema=schema)
            file.write_table(table, row_group_size=max(len(table), 1))

        yield write
