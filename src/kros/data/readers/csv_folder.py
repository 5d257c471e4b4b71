"""A folder of tables, text or Parquet, one episode or several a file, described by a mapping."""

from __future__ import annotations

import logging
import os
import re
import sys
from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from ...core import limits
from ...core.errors import DataError
from ...core.files import did_you_mean, pass_on_shortage, require_regular, shortened
from ..arrow import fill
from ..checks import check_names
from ..population import DEFAULT_CONDITION, EpisodeKey, Population, Role, Unit
from ..prepare import assemble
from ..recording import Recording, Recordings, some, usable
from .csv_mapping import Column, CsvMapping, UnitMapping, load_mapping
from .csvfile import Dialect, first_fields, read_columns

log = logging.getLogger(__name__)
Array = npt.NDArray[np.float64]
ENDINGS = (".csv", ".tsv", ".txt", ".dat", ".csv.gz", ".tsv.gz", ".txt.gz", ".dat.gz", ".parquet")
DEFAULT_UNIT = "unit"
DEFAULT_EPISODE = "0"
_NUMBER = re.compile(r"[-+]?[0-9.]+([eE][-+]?[0-9]+)?")


@dataclass(frozen=True)
class FilePlace:
    """Where an episode is: a file, its columns, those wanted (time first, if any), and which piece of how many."""

    path: str
    names: tuple[str, ...]
    wanted: tuple[str, ...]
    piece: tuple[int, int] = (0, 1)


@dataclass(frozen=True, eq=False)
class CsvRecordings(Recordings):
    """Reads one file at a time; without `time_scale` there is no column of time."""

    dialect: Dialect
    time_scale: float | None
    timestamp: str | None = None

    def file(self, place: FilePlace) -> Path:
        """Return the file of an episode."""
        return Path(place.path)

    def read(self, key: EpisodeKey, place: FilePlace) -> Recording:
        """Return one episode as recorded."""
        i, n = place.piece
        columns = _whole_file(self.dialect, self.timestamp, replace(place, piece=(0, n)), _version(Path(place.path)))
        columns = columns[:, i * columns.shape[1] // n : (i + 1) * columns.shape[1] // n]
        if self.time_scale is None:
            return Recording(key, np.ascontiguousarray(columns.T))
        scale = 1.0 if self.timestamp is not None else self.time_scale
        time = np.where(usable(columns[0]), columns[0], np.nan)
        since = time - time[:1]  # before scaling: milliseconds since 1970 are whole numbers, seconds are not
        return Recording(key, np.ascontiguousarray(columns[1:].T), since * scale)


def _version(path: Path) -> tuple[int, int]:
    require_regular(path, sys.maxsize)
    status = path.stat()
    return status.st_mtime_ns, status.st_size


@lru_cache(maxsize=1)  # pieces of a file are read one behind the other
def _whole_file(dialect: Dialect, timestamp: str | None, place: FilePlace, version: tuple[int, int]) -> Array:
    """Return the wanted columns of a file, shape (len(wanted), n_rows)."""
    path = Path(place.path)
    if path.suffix == ".parquet":
        return parquet_columns(path, place.wanted, timestamp is not None)
    return read_columns(path, place.names, place.wanted, dialect, timestamp)


def read_csv_folder(
    source: Path | str, mapping: CsvMapping | Mapping[str, Any] | Path | str, optional: Collection[str] = ()
) -> Population:
    """Read a folder of CSV files (also gzip-compressed), or of anybody's Parquet files."""
    chosen, source = load_mapping(mapping), Path(source)
    places: dict[EpisodeKey, FilePlace] = {}
    groups: dict[str, str] = {}
    for path, match in _matches(source, chosen):
        fields = file_fields(path, chosen.dialect)
        if optional and not places:
            chosen = chosen.without(_absent(chosen, fields, optional))
        for unit in chosen.units:
            place = _place(path, fields, chosen, unit)
            for i, key in enumerate(_keys(match, chosen, unit)):
                if key in places:
                    twice = f"{key} is in {places[key].path} and in {path}"
                    raise DataError(f"Duplicate episodes: {twice}; name more groups in files, remove or renumber one.")
                check_names(f"part of the path {os.fsencode(path)!r}", (key.unit, key.condition, key.episode))
                places[key] = replace(place, piece=(i, chosen.pieces))
            group = match.groupdict().get("group") or ""
            if groups.setdefault(key.unit, group) != group:
                both = f"in both groups {groups[key.unit]!r} and {group!r} ({path})"
                raise DataError(f"Unit {key.unit} is {both}; a unit has one group.")
    if not places:
        actual = f"no file matches files = {chosen.files!r}{_sample(source)}"
        raise DataError(f"Reading {source} as csv: {actual}; correct the expression.")
    time_scale = None if chosen.time is None else chosen.time_scale
    recordings = CsvRecordings(places, chosen.dialect, time_scale, chosen.timestamp)
    units = [Unit(unit, group) for unit, group in groups.items()]
    facts = (chosen.channels, units, chosen.sample_period_s, chosen.metadata)
    return assemble(recordings, *facts, steps=chosen.steps, scaling=chosen.scaling)


def _keys(match: re.Match[str], mapping: CsvMapping, unit: UnitMapping) -> list[EpisodeKey]:
    """Return the episodes of one unit in a file."""
    groups = match.groupdict()
    name = f"{groups.get('unit') or DEFAULT_UNIT}{unit.suffix}"
    condition, episode = groups.get("condition") or DEFAULT_CONDITION, groups.get("episode") or DEFAULT_EPISODE
    endings = [f".{i + 1}" for i in range(mapping.pieces)] if mapping.pieces > 1 else [""]
    return [EpisodeKey(name, condition, f"{episode}{ending}") for ending in endings]


def _absent(mapping: CsvMapping, fields: list[str], optional: Collection[str]) -> set[str]:
    """Return the channels that are not there and need not be: those that are optional, and truths."""
    spared = [c for c in mapping.channel if c.name in optional or c.role is Role.TRUTH]
    columns = {(c.name, mapping.column(c, unit)) for c in spared for unit in mapping.units}
    numbers = range(1, len(fields) + 1)
    absent = {name for name, column in columns if column not in (numbers if isinstance(column, int) else fields)}
    return absent | {c.name for c in mapping.channel if c.truth_of in absent}


def csv_files(source: Path) -> Iterator[tuple[Path, str]]:
    """Yield the tables below a folder with their relative paths, in order."""
    for folder, folders, names in os.walk(source):
        folders[:] = sorted(f for f in folders if not f.startswith("."))
        for name in sorted(names):
            if name.lower().endswith(ENDINGS) and not name.startswith("."):
                path = Path(folder) / name
                yield path, path.relative_to(source).as_posix()


def _matches(source: Path, mapping: CsvMapping) -> Iterator[tuple[Path, re.Match[str]]]:
    """Yield the files that the mapping describes; the others are counted and named."""
    others = []
    for path, relative in csv_files(source):
        if mapping.exclude and re.search(mapping.exclude, relative):
            continue
        match = re.search(mapping.files, relative)
        if match:
            yield path, match
        else:
            others.append(relative)
    if others:
        text = "%d files in %s do not match files = %r and are left alone: %s."
        log.warning(text, len(others), source, mapping.files, some(others))


def _sample(source: Path) -> str:
    files = [relative for _, relative in csv_files(source)]
    if files:
        return f" of {len(files)} files such as {files[0]!r}"
    return f"; there is no file that ends in {', '.join(ENDINGS[:4])} (or with .gz)"


def _place(path: Path, fields: list[str], mapping: CsvMapping, unit: UnitMapping) -> FilePlace:
    """Return where the channels of a unit are in a file."""
    wanted = [] if mapping.time is None else [mapping.time]
    wanted += [mapping.column(channel, unit) for channel in mapping.ordered]
    names = [f"#{i}" for i in range(1, len(fields) + 1)]  # headers may repeat names that nobody wants
    if mapping.header and all(
        isinstance(c, int) and _NUMBER.fullmatch(f) for c, f in zip(wanted, fields, strict=False)
    ):
        problem = f"one header line is needed, found numbers in the first line: {fields}"
        raise DataError(f"Reading {path}: {problem}; put the names of the columns first, or set header = false.")
    positions = [_position(path, fields, column) for column in wanted]
    for position, column in zip(positions, wanted, strict=True):
        names[position] = column if isinstance(column, str) else f"column {column}"
    return FilePlace(str(path), tuple(names), tuple(names[position] for position in positions))


def _position(path: Path, fields: list[str], column: Column) -> int:
    """Return the position of a column by its name or number."""
    if isinstance(column, int) and column <= len(fields):
        return column - 1
    if fields.count(str(column)) == 1 and isinstance(column, str):
        return fields.index(column)
    if isinstance(column, int):
        problem = f"column {column} is asked for, found {len(fields)} columns"
    elif column in fields:
        problem = f"column {column!r} occurs {fields.count(column)} times, found {fields}"
    else:
        problem = f"column {column!r} is missing{did_you_mean(column, fields) or ','} found {fields}"
    raise DataError(f"Reading {path}: {problem}; correct the mapping or the file.")


def file_fields(path: Path, dialect: Dialect) -> list[str]:
    """Return the names of a file's columns."""
    if path.suffix != ".parquet":
        return first_fields(path, dialect)
    from pyarrow import parquet

    require_regular(path, sys.maxsize)
    try:
        return list(parquet.read_schema(path).names)
    except (OSError, ValueError) as error:
        problem = f"no Parquet file that can be read ({shortened(str(error))})"
        raise DataError(f"Reading {path}: {problem}; check the file.") from error


def parquet_columns(path: Path, wanted: Sequence[str], timestamp: bool = False) -> Array:
    """Read columns of anybody's Parquet file, the first as seconds with `timestamp`, shape (len(wanted), n_rows)."""
    import pyarrow as pa
    from pyarrow import parquet

    require_regular(path, sys.maxsize)
    try:
        if parquet.read_metadata(path).num_rows > limits.MAX_SAMPLES:
            advice = "cut it, or raise MAX_SAMPLES in kros.core.limits"
            raise DataError(f"Reading {path}: has more than {limits.MAX_SAMPLES} rows; {advice}.")
        table = parquet.ParquetFile(path).read(columns=list(wanted), use_threads=False)
        values = np.empty((len(wanted), table.num_rows))
        for i, name in enumerate(wanted):
            column = table.column(name)
            fill(values[i], _seconds(column) if timestamp and i == 0 else column.cast(pa.float64()))
        return values
    except DataError:
        raise
    except (OSError, ValueError, LookupError, MemoryError, NotImplementedError) as error:  # and Arrow's own
        pass_on_shortage(error, path)
        raise DataError(f"Reading {path}: {shortened(str(error))}; correct the file, or the mapping.") from error


def _seconds(column: Any) -> Any:
    import pyarrow as pa
    import pyarrow.compute as pc

    since = column.cast(pa.timestamp("ns")).cast(pa.int64())
    whole = pc.subtract(since, pc.min(since))
    return pc.multiply(whole.cast(pa.float64()), 1e-9)


def parquet_head(path: Path, rows: int) -> tuple[list[str], list[tuple[str, ...]]]:
    """Return the names of a file's columns, and its first rows as text."""
    from pyarrow import parquet

    fields = file_fields(path, Dialect())
    batch = next(parquet.ParquetFile(path).iter_batches(batch_size=rows), None)
    columns = () if batch is None else [["" if v is None else str(v) for v in c.to_pylist()] for c in batch.columns]
    return fields, list(zip(*columns, strict=True))
