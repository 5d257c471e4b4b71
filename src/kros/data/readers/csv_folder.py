"""A folder of tables of text, one episode or several a file, and its mapping, the keys of ``[data.csv]``."""

from __future__ import annotations

import codecs
import logging
import os
import re
from collections.abc import Collection, Iterator, Mapping
from pathlib import Path
from typing import Annotated, Literal

import numpy as np
from pydantic import ConfigDict, Field, field_validator, model_validator

from ...core import ByName, Columns, DataError, Names, Record, Settings, did_you_mean, frozen, read_toml
from ...core.arrays import Texts
from ..measures import clean_unit, measure, split_header
from ..population import DEFAULT_CONDITION, Channel, EpisodeKey, Population, Role, Scaling, Unit, columns_in_order
from ..prepare import assemble
from ..recording import Recording, Recordings, some, usable
from ..steps import Scale, Step
from .formats import FORMATS
from .tables import TIMESTAMP_SCALE, Dialect, Table, stretches

Column = str | Annotated[int, Field(ge=1)]  # a name in the header, or a number counted from 1
GROUPS = ("unit", "condition", "episode", "group")


class ChannelMapping(Settings):
    """``[[channel]]``: a channel and the column it is read from."""

    model_config = ConfigDict(populate_by_name=True)

    name: str = Field(description="of the channel, in everything that follows")
    role: Role = Field(description="what it is to the observer; a truth serves evaluation alone")
    column: Column | None = Field(None, description="name in the header or number from 1; default: the channel's name")
    column_unit: str = Field("", description="of the column; a file that states another one is converted, or refused")
    measured: bool = Field(False, description="whether a state is available at run time")
    unit: str = Field("", description="unit of measure after scaling")
    scale: float = Field(1.0, description="factor from the column to the channel")
    offset: float = Field(0.0, description="added after scaling, as from degC to K, in the channel's unit")
    truth_of: str = Field("", alias="of", description="for the role `truth`: the state that it is the truth of")


class UnitMapping(Settings):
    """``[[unit]]``: one of several units in the same file."""

    suffix: str = Field("", description="appended to the unit's id from the path")
    columns: dict[str, Column] = Field({}, description="column by channel, where it is not that of `[[channel]]`")


class CsvMapping(Dialect):
    r"""How a folder of tables maps to a population; a file that does not match `files` is left alone."""

    files: str = Field(
        description="regular expression searched in the path relative to the folder (with `/`); the named groups "
        "`unit`, `condition`, `episode` and `group` say what a file is, a missing one gets a default"
    )
    channel: tuple[ChannelMapping, ...] = Field(description="the channels, in any order")
    time: Column | None = Field(None, description="column of time")
    unit: tuple[UnitMapping, ...] = Field((), description="where one file holds several units")
    time_scale: float | None = Field(None, gt=0, description="of time, to seconds; default: by its unit in the file")
    sample_period_s: float | None = Field(None, gt=0, description="in place of a column of time")
    exclude: str | None = Field(
        None,
        description="regular expression; paths in which it occurs are left out. Behind the path of a file with several "
        "episodes stands which one, such as log.csv#unit/condition/episode",
    )
    timestamp: Literal["ymd", "dmy", "mdy"] | None = Field(None, description="order of the date in a column of stamps")
    pieces: int = Field(1, ge=1, le=1000, description="equal episodes that a file is cut into, `<episode>.1` ...")
    labels: dict[Literal["unit", "condition", "episode"], Column] = Field(
        {}, description='columns that state what a row belongs to, for example `{unit = "serial"}`'
    )
    metadata: Record = Field({}, description="facts about the batch, for example `{gear_ratio = 100}`")

    @field_validator("files", "exclude")
    @classmethod
    def _expression(cls, value: str | None) -> str | None:
        try:
            unknown = sorted(set(re.compile(value or "").groupindex) - set(GROUPS))
        except (re.error, RecursionError, OverflowError) as error:
            raise ValueError(f"input is not a regular expression ({error})") from error
        if unknown:
            raise ValueError(f"names the group {unknown[0]!r}; known groups are {', '.join(GROUPS)}")
        return value

    @field_validator("encoding")
    @classmethod
    def _known(cls, value: str) -> str:
        try:
            codecs.lookup(value)
        except LookupError as error:
            raise ValueError("input should be an encoding, such as utf-8, latin-1, cp1252 or utf-16") from error
        return value

    @model_validator(mode="after")
    def _consistent(self) -> CsvMapping:
        """Check what a type cannot say."""
        if (self.time is None) == (self.sample_period_s is None):
            raise ValueError(f"give one of time and sample_period_s, found {self.time!r} and {self.sample_period_s!r}")
        if not (_is_mark(self.delimiter) and _is_mark(self.decimal)) or self.delimiter == self.decimal:
            raise ValueError(
                "delimiter and decimal should be two different characters of ASCII that stand in no number otherwise, "
                f"found delimiter = {self.delimiter!r}, decimal = {self.decimal!r}"
            )
        names = [c.name for c in self.channel]
        if not names:
            raise ValueError("there is no [[channel]]; declare each channel with name, column and role")
        for unit in self.units:
            places = [self.column(c, unit) for c in self.channel if c.role is not Role.TRUTH]
            if len(set(places)) < len(places):
                raise ValueError(f"every channel needs a column of its own, found {places}; correct the columns")
            if unknown := sorted(set(unit.columns) - set(names)):
                raise ValueError(f"[[unit]] {unit.suffix!r} gives a column for {unknown[0]!r}; channels are {names}")
        named = next((column for column in self.declared if isinstance(column, str)), None)
        if named is not None and not self.header:
            raise ValueError(f"header = false leaves columns without names, found {named!r}; give its number from 1")
        return self

    @property
    def units(self) -> tuple[UnitMapping, ...]:
        """The units of one file; one without a suffix where none is declared."""
        return self.unit or (UnitMapping(),)

    @property
    def declared(self) -> tuple[Column | None, ...]:
        """All columns that it names; of time none where there is no such column."""
        columns = (self.column(c, u) for u in self.units for c in self.channel)
        return (self.time, *self.labels.values(), *columns)

    @property
    def ordered(self) -> tuple[ChannelMapping, ...]:
        """Channels, states before inputs, truths behind them."""
        return columns_in_order(self.channel)

    @property
    def steps(self) -> tuple[Step, ...]:
        """Scaling as declared per channel."""
        scaled = (c for c in self.ordered if (c.scale, c.offset) != (1, 0))
        return tuple(Scale((c.name,), c.scale, offset=c.offset) for c in scaled)

    @property
    def scaling(self) -> dict[str, Scaling]:
        """Columns of the channels, before any step."""
        columns = {c.name: {self.column(c, unit) for unit in self.units} for c in self.channel}
        return {name: Scaling(next(iter(of)) if len(of) == 1 else None) for name, of in columns.items()}

    def column(self, channel: ChannelMapping, unit: UnitMapping) -> Column:
        """Return where a channel of a unit is read from."""
        return unit.columns.get(channel.name, channel.name if channel.column is None else channel.column)


def _is_mark(text: str) -> bool:
    return len(text) == 1 and text.isascii() and not text.isalnum() and text not in '"+-\r\n\0'


def load_mapping(mapping: CsvMapping | ByName | Path | str) -> CsvMapping:
    """Return a mapping from a TOML file or a table with the same keys."""
    if isinstance(mapping, CsvMapping | Mapping):
        return CsvMapping.of(mapping, "CSV mapping")
    return CsvMapping.of(read_toml(Path(mapping), "CSV mapping"), f"CSV mapping {mapping}")


log = logging.getLogger(__name__)
_NUMBER = re.compile(r"[-+]?[0-9.]+([eE][-+]?[0-9]+)?")
ENDINGS = (".csv", ".tsv", ".txt", ".dat", ".csv.gz", ".tsv.gz", ".txt.gz", ".dat.gz", *FORMATS)


@frozen
class FilePlace:
    """Where an episode is: a table, the columns that are wanted (time first), rows of it, and which piece of these."""

    table: Table
    wanted: Columns
    scales: tuple[tuple[float, float], ...]  # factors and offsets to their declared units of measure
    rows: slice
    piece: tuple[int, int]  # of how many


@frozen
class CsvRecordings(Recordings):
    """Reads one file at a time; without `time_scale` there is no column of time."""

    time_scale: float | None
    timestamp: str | None = None

    def file(self, place: FilePlace) -> Path:
        """Return the file of an episode."""
        return place.table.path

    def read(self, key: EpisodeKey) -> Recording:
        """Return samples in declared units, with time, the first column if there is one, since the first sample."""
        place = self.places[key]
        (i, n), values = place.piece, place.table.numbers(place.wanted, self.timestamp)[place.rows]
        values = values[i * len(values) // n : (i + 1) * len(values) // n]
        factors, offsets = np.transpose(place.scales)
        if self.time_scale is None:
            return Recording(key, values * factors + offsets)
        scale = factors[0] * (self.time_scale if self.timestamp is None else TIMESTAMP_SCALE)
        time = np.where(usable(values[:, 0]), values[:, 0], np.nan)
        since = time - time[:1]  # before scaling: milliseconds since 1970 are whole numbers, seconds are not
        return Recording(key, values[:, 1:] * factors[1:] + offsets[1:], since * scale)


def read_csv_folder(
    source: Path,
    mapping: CsvMapping | ByName | Path | str,
    optional: Collection[str] = (),
    damaged: Texts | None = None,
) -> Population:
    """Read a folder of CSV files; those that cannot be used are collected in `damaged`, with the reason, or refused."""
    chosen = load_mapping(mapping)
    dialect = Dialect(**chosen.model_dump(include=set(Dialect.model_fields)))
    places = dict[EpisodeKey, FilePlace]()
    groups, units_of_measure = Texts(), dict[Column, str]()
    for path, match in _matches(source, chosen):
        named = {name: text for name, text in match.groupdict().items() if text}
        try:
            table = Table.open(path, dialect, chosen.declared)
            if optional and not places:
                chosen = _present(chosen, table.fields, optional)
            episodes = list(_episodes(table, named, chosen, units_of_measure))
        except DataError as error:
            if damaged is None:
                raise
            damaged[match.string] = str(error)
            continue
        for key, place in episodes:
            part = f"{match.string}#{key.unit}/{key.condition}/{key.episode}"
            if place.rows != slice(None) and chosen.exclude and re.search(chosen.exclude, part):
                continue
            if key in places:
                twice = f"{key} is in {places[key].table.path} and in {path}"
                raise DataError(
                    f"Duplicate episodes: {twice}; name more groups in files, name columns in labels, or remove one."
                )
            places[key], group = place, named.get("group", "")
            if groups.setdefault(key.unit, group) != group:
                raise DataError(f"Unit {key.unit} is in both groups {groups[key.unit]!r} and {group!r} ({path}).")
    time_scale = None if chosen.time is None else chosen.time_scale or 1.0
    recordings = CsvRecordings(places, time_scale, chosen.timestamp)
    channels = tuple(Channel(c.name, c.role, c.unit, c.measured, c.truth_of) for c in chosen.ordered)
    facts = ([Unit(unit, group) for unit, group in groups.items()], chosen.sample_period_s, chosen.metadata)
    return assemble(recordings, channels, *facts, steps=chosen.steps, scaling=chosen.scaling)


def _episodes(
    table: Table, named: Texts, mapping: CsvMapping, known: dict[Column, str]
) -> Iterator[tuple[EpisodeKey, FilePlace]]:
    """Yield the episodes of a file, of which its name says some parts; `known` are units of measure of other files."""
    places = [(unit.suffix, _places(table, mapping, unit, known)) for unit in mapping.units]
    columns = [table.texts(position(table, column)) for column in mapping.labels.values()]
    for state, rows in stretches(columns) if columns else [((), slice(None))]:
        labels = dict(zip(mapping.labels, state, strict=True))
        parts = {"unit": "unit", "condition": DEFAULT_CONDITION, "episode": "0", **named, **labels}
        for suffix, place in places:
            for i in range(mapping.pieces):
                episode = parts["episode"] + (f".{i + 1}" if mapping.pieces > 1 else "")
                key = EpisodeKey(parts["unit"] + suffix, parts["condition"], episode)
                yield key, FilePlace(table, *place, rows, (i, mapping.pieces))


def _present(mapping: CsvMapping, fields: Names, optional: Collection[str]) -> CsvMapping:
    """Return the mapping without channels that are not there and need not be: those that are optional, and truths."""
    spared = [c for c in mapping.channel if c.name in optional or c.role is Role.TRUTH]
    units = mapping.units
    absent = {c.name for c in spared for u in units if not _named(fields, mapping.column(c, u), c.column_unit)}
    channel = tuple(c for c in mapping.channel if not {c.name, c.truth_of} & absent)
    return mapping.model_copy(update={"channel": channel})


def csv_files(source: Path) -> dict[str, Path]:
    """Return the tables below a folder by their relative paths, in order."""
    files = {}
    for folder, folders, names in os.walk(source):
        folders[:] = sorted(f for f in folders if not f.startswith("."))
        for name in sorted(names):
            if name.lower().endswith(ENDINGS) and not name.startswith("."):
                path = Path(folder) / name
                files[path.relative_to(source).as_posix()] = path
    return files


def _matches(source: Path, mapping: CsvMapping) -> list[tuple[Path, re.Match[str]]]:
    """Return the files that the mapping describes; the others are counted and named."""
    files, matches, others = csv_files(source), [], []
    for relative, path in files.items():
        if mapping.exclude and re.search(mapping.exclude, relative):
            continue
        if match := re.search(mapping.files, relative):
            matches.append((path, match))
        else:
            others.append(relative)
    if not matches:
        none = f"there is no file that ends in {', '.join(ENDINGS[:4])}"
        there = f"there are {len(files)} files such as {next(iter(files))!r}" if files else none
        problem = f"no file matches files = {mapping.files!r}, {there}"
        raise DataError(f"Reading {source} as csv: {problem}; correct the expression, or exclude.")
    if others:
        text = "%d files in %s do not match files = %r and are ignored: %s."
        log.warning(text, len(others), source, mapping.files, some(others))
    return matches


def _places(
    table: Table, mapping: CsvMapping, unit: UnitMapping, known: dict[Column, str]
) -> tuple[Columns, tuple[tuple[float, float], ...]]:
    """Return where the channels of a unit are in a file, with factors and offsets to their units of measure."""
    scaled = mapping.time_scale is not None or mapping.timestamp is not None
    wanted = [] if mapping.time is None else [(mapping.time, "" if scaled else "s")]
    wanted += [(mapping.column(channel, unit), channel.column_unit) for channel in mapping.ordered]
    numbered = all(isinstance(c, int) and _NUMBER.fullmatch(f) for (c, _), f in zip(wanted, table.fields, strict=False))
    if mapping.header and numbered:
        problem = f"one header line is needed, found numbers in the first line: {list(table.fields)}"
        raise DataError(f"Reading {table.path}: {problem}; put the names of the columns first, or set header = false.")
    at = tuple(position(table, *column) for column in wanted)
    return at, tuple(_conversion(table, i, *column, known) for i, column in zip(at, wanted, strict=True))


def _conversion(table: Table, at: int, column: Column, declared: str, known: dict[Column, str]) -> tuple[float, float]:
    """Return factor and offset from the unit that a file states of a column to the one that is declared."""
    stated, declared = table.units[at], declared or split_header(str(column))[1]
    usual = declared or (known.setdefault(column, stated) if stated else "")
    if not stated or clean_unit(usual) == stated:
        return 1.0, 0.0
    ours, theirs = (measure(text, table.fields[at]) for text in (usual, stated))
    if not declared and (None in (ours, theirs) or ours == theirs):
        return 1.0, 0.0
    if not declared or ours is None or theirs is None or ours.si != theirs.si:
        where = "declared" if declared else "in another file"
        problem = f"column {column!r} is in {stated!r}, and {where} in {usual!r}"
        raise DataError(f"Reading {table.path}: {problem}; correct the file, or column_unit (time_scale).")
    return theirs.factor / ours.factor, (theirs.offset - ours.offset) / ours.factor


def _named(fields: Names, column: Column, unit: str) -> list[int]:
    """Return the positions of a column by number or name; a declared unit may differ from that in the header."""
    places = [i for i, field in enumerate(fields) if column in (field, i + 1)]
    name, written = split_header(str(column))
    if not places and (unit or written):
        places = [i for i, field in enumerate(fields) if split_header(field)[0] == name]
    return places


def position(table: Table, column: Column, unit: str = "") -> int:
    """Return the position of a column, see `_named`."""
    places = _named(table.fields, column, unit)
    if len(places) == 1:
        return places[0]
    problem = f"occurs {len(places)} times," if places else f"is missing{did_you_mean(column, table.fields)}"
    found = f"found {list(table.fields)}; correct the mapping or the file"
    raise DataError(f"Reading {table.path}: column {column!r} {problem} {found}.")
