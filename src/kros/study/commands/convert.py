"""Conversion of any supported recording to Parquet."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from ...core.files import read_toml, whole_folder
from ...core.work import Progress
from ...data import Population, read
from ...data.checks import check_population
from ...data.readers.opening import detect_reader
from ...data.readers.parquet import GroupRecord, read_parquet, write_group, write_index
from ..engine.executors import open_executor

Task = tuple[Population, str, str, Path]


def read_mapping(path: Path) -> dict[str, Any]:
    """Read a CSV mapping from TOML."""
    return read_toml(path, "--mapping")


def write_one(task: Task) -> GroupRecord:
    """Write one unit and condition, in a worker."""
    population, unit, condition, folder = task
    return write_group(population, unit, condition, folder)


def convert_recordings(
    source: Path, out: Path, reader: str | None, mapping: Path | None, workers: int, progress: Progress
) -> Population:
    """Convert recordings; the output folder appears whole or not at all."""
    csv = read_mapping(mapping) if mapping is not None else None
    chosen = reader or ("csv" if csv is not None else detect_reader(source))
    population = read(source, chosen, mapping=csv)
    check_population(population, allow_single=True)
    groups = [(u, c) for u, c, _ in population.groups()]
    progress.start("convert", len(groups))
    with whole_folder(out) as folder, open_executor(workers) as executor:
        records = []
        for record in executor.map(write_one, [(population.select([u], [c]), u, c, folder) for u, c in groups]):
            records.append(record)
            progress.advance()
        write_index(population, records, folder)
    return read_parquet(out)
