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
    import pyarrow as pa
    from pyarrow import csv, parquet

    labels = [pa.field(name, pa.int64() if name == "k" else pa.string()) for name in KEYS]
    units = {name: {"unit": unit} if unit else None for name, unit in facts["columns"].items()}
    columns = [pa.field(name, pa.float64(), metadata=unit) for name, unit in units.items()]
    about = {n: v if isinstance(v, str) else json.dumps(v) for n, v in facts.items() if v is not None}
    schema, text = pa.schema([*labels, *columns], metadata=about), out.suffix == ".csv"
    out.parent.mkdir(parents=True, exist_ok=True)
    temporary = out.with_name(f".{out.name}.partial")
    try:
        with (
            csv.CSVWriter(temporary, schema)
            if text
            else parquet.ParquetWriter(temporary, schema, write_page_checksum=True)
        ) as file:

            def write(key: EpisodeKey, start: int, values: Array) -> None:
                names = [pa.repeat(name, len(values)) for name in (key.unit, key.condition, key.episode)]
                samples = pa.array(np.arange(start, start + len(values)))
                numbers = [pa.array(np.ascontiguousarray(column)) for column in values.T]
                file.write_table(pa.Table.from_arrays([*names, samples, *numbers], schema=schema), max(len(values), 1))

            yield write
        if text:
            write_json(out.with_name(f"{out.name}-metadata.json"), facts)
        temporary.replace(out)
    finally:
        temporary.unlink(missing_ok=True)
