"""A folder of tables, text or Parquet, one episode or several a file, described by a mapping."""

from __future__ import annotations

import logging
import os
import re
import sys
from collections.abc import Collection, Iterator, Mapping
from dataclasses import dataclass, replace
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from ...core.errors import DataError
from ...core.files import did_you_mean, require_regular, stamp_of
from ..checks import check_names
from ..population import DEFAULT_CONDITION, EpisodeKey, Population, Role, Unit
from ..prepare import assemble
from ..recording import Recording, Recordings, some, usable
from .csv_mapping import Column, CsvMapping, UnitMapping, load_mapping
from .tables import Dialect, file_fields, read_columns

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
        require_regular(Path(place.path), sys.maxsize)
        columns = _whole_file(self, replace(place, piece=(0, n)), stamp_of(Path(place.path)))
        columns = columns[:, i * columns.shape[1] // n : (i + 1) * columns.shape[1] // n]
        if self.time_scale is None:
            return Recording(key, np.ascontiguousarray(columns.T))
        scale = 1.0 if self.timestamp is not None else self.time_scale
        time = np.where(usable(columns[0]), columns[0], np.nan)
        since = time - time[:1]  # before scaling: milliseconds since 1970 are whole numbers, seconds are not
        return Recording(key, np.ascontiguousarray(columns[1:].T), since * scale)


@lru_cache(maxsize=1)  # pieces of a file are read one behind the other
def _whole_file(recordings: CsvRecordings, place: FilePlace, version: tuple[int, int]) -> Array:
    """Return the wanted columns of a file, shape (len(wanted), n_rows)."""
    return read_columns(Path(place.path), place.names, place.wanted, recordings.dialect, recordings.timestamp)


def read_csv_folder(
    source: Path | str, mapping: CsvMapping | Mapping[str, Any] | Path | str, optional: Collection[str] = ()
) -> Population:
    """Read a folder of CSV files (also gzip-compressed), or of Parquet files of any layout."""
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
        files, endings = [relative for _, relative in csv_files(source)], ", ".join(ENDINGS[:4])
        sample = f" of {len(files)} files such as {files[0]!r}" if files else ""
        actual = f"no file matches files = {chosen.files!r}{sample or f'; there is no file that ends in {endings}'}"
        raise DataError(f"Reading {source} as csv: {actual}; correct the expression.")
    time_scale = None if chosen.time is None else chosen.time_scale
    recordings = CsvRecordings(places, chosen.dialect, time_scale, chosen.timestamp)
    units = [Unit(unit, group) for unit, group in groups.items()]
    facts = (chosen.channels, units, chosen.sample_period_s, chosen.metadata)
    return assemble(recordings, *facts, steps=chosen.steps, scaling=chosen.scaling)


def _keys(match: re.Match[str], mapping: CsvMapping, unit: UnitMapping) -> list[EpisodeKey]:
    """Return the episodes of one unit in a file."""
    groups = {name: text for name, text in match.groupdict().items() if text}
    name = f"{groups.get('unit', DEFAULT_UNIT)}{unit.suffix}"
    condition, episode = groups.get("condition", DEFAULT_CONDITION), groups.get("episode", DEFAULT_EPISODE)
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
        text = "%d files in %s do not match files = %r and are ignored: %s."
        log.warning(text, len(others), source, mapping.files, some(others))


def _place(path: Path, fields: list[str], mapping: CsvMapping, unit: UnitMapping) -> FilePlace:
    """Return where the channels of a unit are in a file."""
    wanted = [] if mapping.time is None else [mapping.time]
    wanted += [mapping.column(channel, unit) for channel in mapping.ordered]
    names = [f"#{i}" for i in range(1, len(fields) + 1)]  # headers may repeat names that are not needed
    numbered = all(isinstance(c, int) and _NUMBER.fullmatch(f) for c, f in zip(wanted, fields, strict=False))
    if mapping.header and numbered:
        problem = f"one header line is needed, found numbers in the first line: {fields}"
        raise DataError(f"Reading {path}: {problem}; put the names of the columns first, or set header = false.")
    positions = [_position(path, fields, column) for column in wanted]
    for position, column in zip(positions, wanted, strict=True):
        names[position] = column if isinstance(column, str) else f"column {column}"
    return FilePlace(str(path), tuple(names), tuple(names[position] for position in positions))


def _position(path: Path, fields: list[str], column: Column) -> int:
    """Return the position of a column by its name or number."""
    places = [i for i, field in enumerate(fields) if column in (field, i + 1)]
    if len(places) == 1:
        return places[0]
    problem = f"column {column!r} is missing{did_you_mean(column, fields) or ','} found {fields}"
    if isinstance(column, int):
        problem = f"column {column} is asked for, found {len(fields)} columns"
    elif places:
        problem = f"column {column!r} occurs {len(places)} times, found {fields}"
    raise DataError(f"Reading {path}: {problem}; correct the mapping or the file.")
