"""A folder of tables, text or Parquet, described by a mapping."""

from __future__ import annotations

import logging
import os
import re
import sys
from collections.abc import Collection, Iterator, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from ...core.errors import DataError
from ...core.files import did_you_mean, require_regular
from ..checks import check_names
from ..population import DEFAULT_CONDITION, EpisodeKey, Population, Role, Unit
from ..prepare import assemble
from ..recording import Recording, Recordings, some, usable
from .csv_mapping import Column, CsvMapping, UnitMapping, load_mapping
from .csvfile import Dialect, first_fields, read_columns
from .parquet_table import parquet_columns, parquet_fields

log = logging.getLogger(__name__)
ENDINGS = (".csv", ".tsv", ".txt", ".dat", ".csv.gz", ".tsv.gz", ".txt.gz", ".dat.gz", ".parquet")
DEFAULT_UNIT = "unit"
DEFAULT_EPISODE = "0"


@dataclass(frozen=True)
class FilePlace:
    """Where an episode is: a file, the names of its columns, those wanted (time first, where there is one), and which piece of how many."""

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
        path, (i, n) = Path(place.path), place.piece
        columns = self._columns(path, place) if n == 1 else _latest(self, replace(place, piece=(0, n)), *_version(path))
        columns = columns[:, i * columns.shape[1] // n : (i + 1) * columns.shape[1] // n]
        if self.time_scale is None:
            return Recording(key, np.ascontiguousarray(columns.T))
        scale = 1.0 if self.timestamp is not None else self.time_scale
        time = np.where(usable(columns[0]), columns[0], np.nan)
        since = time - time[:1]  # before scaling: milliseconds since 1970 are whole numbers, seconds are not
        return Recording(key, np.ascontiguousarray(columns[1:].T), since * scale)

    def _columns(self, path: Path, place: FilePlace) -> npt.NDArray[np.float64]:
        if path.suffix == ".parquet":
            return parquet_columns(path, place.wanted, self.timestamp is not None)
        return read_columns(path, place.names, place.wanted, self.dialect, self.timestamp)


def _version(path: Path) -> tuple[int, int]:
    require_regular(path, sys.maxsize)
    status = path.stat()
    return status.st_mtime_ns, status.st_size


_kept: dict[str, tuple[Any, npt.NDArray[np.float64]]] = {}


def _latest(recordings: CsvRecordings, place: FilePlace, *version: int) -> npt.NDArray[np.float64]:
    """Return the columns of a file of which pieces are read one behind the other: the latest one is kept."""
    asked = (place, recordings.dialect, recordings.timestamp, version)
    if "latest" not in _kept or _kept["latest"][0] != asked:
        _kept["latest"] = asked, recordings._columns(Path(place.path), place)
    return _kept["latest"][1]


def read_csv_folder(
    source: Path | str, mapping: CsvMapping | Mapping[str, Any] | Path | str, optional: Collection[str] = ()
) -> Population:
    """Read a folder of CSV files (also gzip-compressed), or of anybody's Parquet files."""
    chosen, source = load_mapping(mapping), Path(source)
    dialect = chosen.dialect
    places: dict[EpisodeKey, FilePlace] = {}
    groups: dict[str, str] = {}
    for path, match in _matches(source, chosen):
        fields = parquet_fields(path) if path.suffix == ".parquet" else first_fields(path, dialect)
        if optional and not places:
            chosen = chosen.without(_absent(chosen, fields, optional))
        found = match.groupdict()
        for unit in chosen.units:
            place, group = _place(path, fields, chosen, unit), found.get("group") or ""
            for i in range(chosen.pieces):
                key = EpisodeKey(
                    f"{found.get('unit') or DEFAULT_UNIT}{unit.suffix}",
                    found.get("condition") or DEFAULT_CONDITION,
                    f"{found.get('episode') or DEFAULT_EPISODE}{f'.{i + 1}' if chosen.pieces > 1 else ''}",
                )
                if key in places:
                    raise DataError(
                        f"Duplicate episodes: {key} is in {places[key].path} and in {path}; name more groups in files, or exclude one."
                    )
                check_names(f"part of the path {os.fsencode(path)!r}", (key.unit, key.condition, key.episode))
                places[key] = replace(place, piece=(i, chosen.pieces))
            if groups.setdefault(key.unit, group) != group:
                raise DataError(
                    f"Unit {key.unit} is in both groups {groups[key.unit]!r} and {group!r} ({path}); a unit has one group."
                )
    if not places:
        raise DataError(
            f"Reading {source} as csv: no file matches files = {chosen.files!r}{_sample(source)}; correct the expression."
        )
    recordings = CsvRecordings(places, dialect, None if chosen.time is None else chosen.time_scale, chosen.timestamp)
    units = [Unit(unit, group) for unit, group in groups.items()]
    period = chosen.sample_period_s
    return assemble(
        recordings, chosen.channels, units, period, chosen.metadata, steps=chosen.steps, scaling=chosen.scaling
    )


def _absent(mapping: CsvMapping, fields: list[str], optional: Collection[str]) -> set[str]:
    """Return the channels that are not there and need not be: those that are optional, and truths."""
    spared = [c for c in mapping.channel if c.name in optional or c.role is Role.TRUTH]
    columns = {(c.name, mapping.column(c, unit)) for c in spared for unit in mapping.units}
    absent = {
        name for name, column in columns if (column > len(fields) if isinstance(column, int) else column not in fields)
    }
    return absent | {c.name for c in mapping.channel if c.of in absent}


def csv_files(source: Path) -> Iterator[tuple[Path, str]]:
    """Yield the text tables below a folder with their relative paths, in order."""
    for folder, folders, names in os.walk(source):
        folders[:] = sorted(f for f in folders if not f.startswith("."))
        for name in sorted(names):
            if name.lower().endswith(ENDINGS) and not name.startswith("."):
                path = Path(folder) / name
                yield path, path.relative_to(source).as_posix()


def _matches(source: Path, mapping: CsvMapping) -> Iterator[tuple[Path, re.Match[str]]]:
    other = []
    for path, relative in csv_files(source):
        if mapping.exclude and re.search(mapping.exclude, relative):
            continue
        match = re.search(mapping.files, relative)
        if match:
            yield path, match
        else:
            other.append(relative)
    if other:
        log.warning(
            "%d files in %s do not match files = %r and are left alone: %s.",
            len(other),
            source,
            mapping.files,
            some(other),
        )


def _sample(source: Path) -> str:
    files = [relative for _, relative in csv_files(source)]
    return (
        f" of {len(files)} files such as {files[0]!r}"
        if files
        else f"; there is no file that ends in {', '.join(ENDINGS[:4])} (or with .gz)"
    )


def _place(path: Path, fields: list[str], mapping: CsvMapping, unit: UnitMapping) -> FilePlace:
    wanted: list[Column | None] = [mapping.time] if mapping.time is not None else []
    wanted += [mapping.column(channel, unit) for channel in mapping.ordered]
    names = [f"#{i}" for i in range(1, len(fields) + 1)]  # headers may repeat names that nobody wants
    positions = [_position(path, fields, column) for column in wanted]
    for position, column in zip(positions, wanted, strict=True):
        names[position] = column if isinstance(column, str) else f"column {column}"
    return FilePlace(str(path), tuple(names), tuple(names[position] for position in positions))


def _position(path: Path, fields: list[str], column: Column | None) -> int:
    if isinstance(column, int):
        if column > len(fields):
            raise DataError(
                f"Reading {path}: column {column} is asked for, found {len(fields)} columns; correct the mapping or the file."
            )
        return column - 1
    if fields.count(str(column)) != 1:
        problem = (
            f"is missing{did_you_mean(column, fields) or ','}"
            if column not in fields
            else f"occurs {fields.count(str(column))} times,"
        )
        raise DataError(f"Reading {path}: column {column!r} {problem} found {fields}; correct the mapping or the file.")
    return fields.index(str(column))
