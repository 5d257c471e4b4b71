"""A folder of somebody's recordings, described: how files are written, what their names say, what columns are, what looks wrong.

folder ── dialect ── names of files ── columns ── parts ── mapping ── every episode looked at ── Discovery
"""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from ...core.errors import ConfigError, DataError
from ...core.files import did_you_mean
from ...core.work import Work
from ..population import EpisodeKey, Population
from ..readers.csv_folder import csv_files, read_csv_folder
from ..readers.csvfile import Dialect, first_fields, read_columns
from ..readers.parquet_table import parquet_columns, parquet_fields, parquet_head
from ..recording import some, usable
from .dialect import TableHead, look_at
from .examine import Examined, examine
from .filenames import infer_names, quoted
from .measures import SECONDS
from .roles import UNKNOWN, ColumnPart, TableColumn, describe, propose, time_columns, time_scale

Array = npt.NDArray[np.float64]
Ask = Callable[[Sequence[TableColumn]], Sequence[TableColumn]]
LOOKED_AT, SAMPLED = 15, 6  # files whose first lines, and whose numbers, say what columns are
PIECES, SHORTEST_PIECE = 5, 200  # episodes that a single long recording is cut into, and the samples that each needs


@dataclass(frozen=True)
class Wanted:
    """What is said about a folder already."""

    measured: tuple[str, ...] = ()
    inputs: tuple[str, ...] = ()  # as `measured`: names of channels or of columns
    files: str | None = None  # regular expression in place of the one that is found
    period_s: float | None = None  # where there is no column of time


@dataclass(frozen=True)
class Discovery:
    """What was found in a folder."""

    mapping: dict[str, Any]  # table ``[data.csv]``, with the keys that are not default
    prepare: tuple[dict[str, Any], ...]  # steps of preparation that the recordings need
    columns: tuple[TableColumn, ...]  # all of them, with their parts
    population: Population  # as the mapping reads it, before preparation
    notes: dict[str, str] = field(default_factory=dict)  # what a key of the mapping rests on
    findings: tuple[str, ...] = ()  # what looks wrong
    drop_nan: bool = False  # whether episodes with NaN or infinity have to be dropped
    reading: str = ""  # what the first file was taken for


def discover(source: Path, wanted: Wanted | None = None, ask: Ask | None = None, work: Work | None = None) -> Discovery:
    """Describe a folder of text tables or of anybody's Parquet files."""
    wanted = wanted or Wanted()
    files = {relative: path for path, relative in csv_files(source)}
    if wanted.files is not None:
        files = {relative: path for relative, path in files.items() if _expression(wanted.files).search(relative)}
    if not files and wanted.files is not None:
        raise DataError(
            f"Looking at {source}: no file matches --files {wanted.files!r}; correct the expression, or leave it out."
        )
    if not files:
        others = Counter(p.suffix.lower() for p in source.rglob("*") if p.is_file() and p.suffix).most_common(1)
        instead = f"save its {others[0][1]} {others[0][0]} files as CSV or Parquet" if others else "check the folder"
        raise DataError(
            f"Looking at {source}: there are no files of recordings (.csv, .tsv, .txt, .dat, .parquet, or these with .gz); {instead}."
        )
    head, own, strange = _alike(files)
    names = infer_names(list(own))
    mapping: dict[str, Any] = {"files": wanted.files or names.pattern}
    notes: dict[str, str] = {}
    if wanted.files is None and not names.sure:
        notes["files"] = "a guess from the order of the words in file names: look at the units and episodes below"
    if wanted.files is None and names.other is not None:
        raise ConfigError(
            f"Names of files: {some(list(own), 3)} can be episodes of one unit or units with one recording each; choose, "
            f"--files '{names.other}' or --files '{names.pattern}'."
        )
    mapping |= _dialect_keys(head.dialect)
    columns, timing = _columns(source, head, own, wanted)
    mapping |= timing[0]
    notes |= timing[1]
    columns = _decided(columns, wanted, ask)
    mapping["channel"] = [
        _channel(c) for c in columns if c.part in (ColumnPart.MEASURED, ColumnPart.STATE, ColumnPart.INPUT)
    ]
    excluded = {
        relative: f"its columns are others than those of {next(iter(own))}"
        for relative in strange
        if re.search(mapping["files"], relative)
    }
    return _examined(source, mapping, notes, columns, excluded, strange, work)


def _expression(text: str) -> re.Pattern[str]:
    try:
        return re.compile(text)
    except re.error as error:
        raise ConfigError(f"--files {text!r}: is not a regular expression ({error}); correct it.") from error


def _alike(files: dict[str, Path]) -> tuple[TableHead, dict[str, Path], list[str]]:
    """Return how most files are written, those files, and the others."""
    paths = list(files.items())
    heads: list[TableHead] = []
    for _, path in paths[:: max(1, len(paths) // LOOKED_AT)]:
        try:
            heads.append(_head_of(path))
        except DataError:
            continue
    if not heads:
        raise DataError(
            f"Looking at {paths[0][1].parent}: none of the files looked at holds rows of numbers; check the folder."
        )
    commonest = Counter((h.dialect, h.fields) for h in heads).most_common(1)[0][0]
    head = next(h for h in heads if (h.dialect, h.fields) == commonest)
    own, strange = {}, []
    for relative, path in paths:
        try:
            fits = _fits(path, head)
        except DataError:
            fits = False
        if fits:
            own[relative] = path
        else:
            strange.append(relative)
    return head, own, strange


def _fits(path: Path, head: TableHead) -> bool:
    """Tell whether a file has the columns of the others, where they have them."""
    wanted = set(head.fields) - {""}
    if path.suffix != ".parquet":
        there = first_fields(path, head.dialect)
        return len(there) == len(head.fields) if not head.dialect.header else wanted <= set(there)
    return wanted <= set(parquet_fields(path))


def _head_of(path: Path) -> TableHead:
    if path.suffix == ".parquet":
        fields, rows = parquet_head(path)
        return TableHead(Dialect(), tuple(fields), ("",) * len(fields), tuple(rows))
    return look_at(path)


def _dialect_keys(dialect: Dialect) -> dict[str, Any]:
    plain = Dialect()
    names = ("delimiter", "decimal", "encoding", "header", "skip_rows", "unit_rows")
    return {name: getattr(dialect, name) for name in names if getattr(dialect, name) != getattr(plain, name)}


def _columns(
    source: Path, head: TableHead, own: dict[str, Path], wanted: Wanted
) -> tuple[list[TableColumn], tuple[dict[str, Any], dict[str, str]]]:
    """Return the columns with the parts that are proposed, and the keys that say what time is, with what they rest on."""
    described: list[TableColumn] = []
    for i, (header, unit) in enumerate(zip(head.fields, head.units, strict=True)):
        column = describe(header or f"column {i + 1}", unit, [c.name for c in described])
        if not head.dialect.header:
            column = replace(column, header=str(i + 1), number=i + 1)
        elif head.fields.count(header) > 1:
            column = replace(column, number=i + 1)
        described.append(column)
    numeric = [i for i in range(len(described)) if head.is_numeric(i) and head.fields[i]]
    texts = [i for i in range(len(described)) if head.timestamp(i) is not None]
    paths = list(own.values())
    samples = [_numbers(path, head, numeric) for path in paths[:: max(1, len(paths) // SAMPLED)]]
    samples = [s for s in samples if s.shape[1] > 2]
    if not samples:
        _read(paths[0], head, numeric)  # says why not, where it cannot be read
        raise DataError(
            f"Looking at {source}: the files looked at have fewer than three rows of numbers; check the folder."
        )
    chosen = [described[i] for i in numeric]
    keys: dict[str, Any] = {}
    notes: dict[str, str] = {}
    candidates = time_columns(chosen, samples) if wanted.period_s is None else []
    if wanted.period_s is not None:
        keys["sample_period_s"] = wanted.period_s
    elif candidates and not (texts and chosen[candidates[0]].kind != "time"):
        at = candidates[0]
        unit = chosen[at].unit if chosen[at].unit.lower() in SECONDS else ""
        scale, why = time_scale(unit, float(np.median(np.diff(samples[0][at]))))
        keys["time"] = described[numeric[at]].reference
        if scale != 1:
            keys["time_scale"] = scale
            notes["time_scale"] = why
        chosen[at] = replace(chosen[at], part=ColumnPart.TIME)
    elif texts:
        keys |= {"time": described[texts[-1]].reference, "timestamp": head.timestamp(texts[-1])}
        described[texts[-1]] = replace(described[texts[-1]], part=ColumnPart.TIME)
    else:
        found = ", ".join(repr(c.header) for c in described)
        called = next((c.header for c in described if c.kind == "time"), None)
        problem = (
            "no column increases like time"
            if called is None
            else f"{called!r} stands still or runs back in places, as rounded times do"
        )
        raise DataError(
            f"Looking at {source}: {problem}, found the columns {found}; give the sampling period, --period SECONDS."
        )
    proposed = propose(chosen, samples)
    for place, column in zip(numeric, proposed, strict=True):
        described[place] = column
    rest = {i for i in range(len(described)) if i not in numeric and described[i].part is not ColumnPart.TIME}
    return [replace(c, why="no numbers") if i in rest else c for i, c in enumerate(described) if head.fields[i]], (
        keys,
        notes,
    )


def _numbers(path: Path, head: TableHead, columns: Sequence[int]) -> Array:
    """Read the numeric columns of a file, shape (n_columns, n_rows); no rows where it cannot be read."""
    try:
        values = _read(path, head, columns)
        return np.where(usable(values), values, np.nan)
    except DataError:
        return np.zeros((len(columns), 0))


def _read(path: Path, head: TableHead, columns: Sequence[int]) -> Array:
    if path.suffix == ".parquet":
        return parquet_columns(path, [head.fields[i] for i in columns])
    names = [f"{field or 'column'} #{i + 1}" for i, field in enumerate(head.fields)]
    return read_columns(path, names, [names[i] for i in columns], head.dialect)


def _channel(column: TableColumn) -> dict[str, Any]:
    table: dict[str, Any] = {"name": column.name}
    if column.reference != column.name:
        table["column"] = column.reference
    table["role"] = "input" if column.part is ColumnPart.INPUT else "state"
    if column.part is ColumnPart.MEASURED:
        table["measured"] = True
    if column.unit:
        table["unit"] = column.unit
    if column.scale != 1:
        table["scale"] = column.scale
    return table


def _decided(columns: Sequence[TableColumn], wanted: Wanted, ask: Ask | None) -> list[TableColumn]:
    """Return the columns with the parts that were asked for, else proposed."""
    decided = assign(columns, wanted.measured, wanted.inputs)
    if ask is not None and not (wanted.measured and wanted.inputs):
        decided = list(ask(decided))
    for part, option, what in (
        (ColumnPart.MEASURED, "--measured", "a measured state"),
        (ColumnPart.INPUT, "--input", "an input"),
    ):
        if not any(c.part is part for c in decided):
            names = ", ".join(
                c.name if c.name == c.header else f"{c.name} ({c.header!r})"
                for c in decided
                if c.part is not ColumnPart.TIME
            )
            raise ConfigError(
                f"Roles: no column is {what} by its name; name it, {option} NAME. The columns are {names}."
            )
    if any(c.part is ColumnPart.STATE for c in decided):
        return decided
    return [
        replace(c, part=ColumnPart.STATE) if c.why == UNKNOWN else c for c in decided
    ]  # an observer is for what is not measured


def assign(columns: Sequence[TableColumn], measured: Sequence[str], inputs: Sequence[str]) -> list[TableColumn]:
    """Return the columns with measured states and inputs as named, where any are named."""
    decided = list(columns)
    for part, names in ((ColumnPart.MEASURED, measured), (ColumnPart.INPUT, inputs)):
        places = [_place(decided, name) for name in names]
        if not places:
            continue
        for i, column in enumerate(decided):
            if i in places:
                decided[i] = replace(column, part=part, why="as you said")
            elif column.part is part:
                decided[i] = replace(
                    column, part=ColumnPart.STATE if part is ColumnPart.MEASURED else ColumnPart.LEFT_OUT
                )
    return decided


def _place(columns: Sequence[TableColumn], name: str) -> int:
    for attribute in ("name", "header"):
        for i, column in enumerate(columns):
            if getattr(column, attribute) == name:
                return i
    known = [c.name for c in columns]
    raise ConfigError(
        f"Roles: there is no column {name!r}{did_you_mean(name, known) or ';'} The columns are {', '.join(known)}."
    )


def _examined(
    source: Path,
    mapping: dict[str, Any],
    notes: dict[str, str],
    columns: Sequence[TableColumn],
    excluded: dict[str, str],
    strange: Sequence[str],
    work: Work | None,
) -> Discovery:
    """Look at every episode, and leave out what cannot be used."""
    findings = [f"{len(strange)} files are not like the others and left alone: {some(strange)}"] if strange else []
    population = _opened(source, mapping, excluded)
    found = examine(population, work)
    if not found.counts:
        key, why = next(iter(found.wrong.items()), (found.nan[0] if found.nan else "", "no number in some samples"))
        raise DataError(f"Looking at {source}: none of {len(population.episodes)} episodes can be used; {key}: {why}.")
    period = population.sample_period_s
    few = {group: n for group, n in found.counts.items() if n < 2}
    if few and 2 * len(few) > len(found.counts) and found.shortest >= PIECES * SHORTEST_PIECE:
        mapping = mapping | {"pieces": PIECES}
        notes["pieces"] = "there is one recording for most units and conditions: each is cut into so many episodes"
        few = {}
    wrong = {_relative(population, source, key): f"{key}: {why}" for key, why in found.wrong.items()}
    findings += [f"left out, {text}" for text in wrong.values()] + list(found.doubts)
    for unit, condition in few:
        for key in population.keys(unit, condition):
            if key not in found.wrong:
                wrong[_relative(population, source, key)] = f"{key}: the only episode of its unit and condition"
        findings.append(
            f"left out, unit {unit} ({condition}) has {found.counts[unit, condition]} episode that can be used, and two are needed"
        )
    if found.nan:
        findings.append(f"{len(found.nan)} episodes hold NaN or infinity and are dropped, {found.nan[0]} the first")
    mapping = mapping | _exclusion({**excluded, **wrong})
    kept = _opened(source, mapping, {})
    findings += _too_few(kept, found)
    prepare: tuple[dict[str, Any], ...] = ()
    if found.resample_s is not None:
        bridged = {"max_gap_s": found.max_gap_s} if found.max_gap_s is not None else {}
        prepare = ({"step": "resample", "period_s": found.resample_s, **bridged},)
        key, sample = found.uneven or (kept.episodes[0], 0)
        where = f", the worst step in {_relative(population, source, key)} at sample {sample}" if found.uneven else ""
        findings.append(
            f"time is uneven: everything is brought to a period of {found.resample_s:g} s (recorded at about {period:.4g} s){where}"
        )
    return Discovery(
        mapping, prepare, tuple(columns), kept, notes, tuple(findings), bool(found.nan), _reading(kept, source)
    )


def _reading(population: Population, source: Path) -> str:
    """Return what the path of the first episode was taken for."""
    key, groups = population.episodes[0], sorted({unit.group for unit in population.units if unit.group})
    group = f", group {population.unit(key.unit).group!r} of {some(groups)}" if groups else ""
    return f"{_relative(population, source, key)}: unit {key.unit!r}, condition {key.condition!r}, episode {key.episode!r}{group}"


def _opened(source: Path, mapping: dict[str, Any], excluded: dict[str, str]) -> Population:
    return read_csv_folder(source, mapping | _exclusion(excluded))


def _exclusion(excluded: dict[str, str]) -> dict[str, Any]:
    return {"exclude": f"^(?:{'|'.join(quoted(name) for name in excluded)})$"} if excluded else {}


def _relative(population: Population, source: Path, key: EpisodeKey) -> str:
    recordings: Any = population.source
    return Path(recordings.recordings.places[key].path).relative_to(source).as_posix()


def _too_few(population: Population, found: Examined) -> list[str]:
    units = population.unit_ids
    counts = {(u, c): len(keys) for u, c, keys in population.groups()}
    texts = []
    if len(units) < 2:
        texts.append(
            f"one unit ({units[0]}): models can be identified (kros run ... --until identify), and a population takes at least two"
        )
    elif len(units) < 4:
        texts.append(
            f"{len(units)} units: what differs between units is hardly known from so few, and no outlier can be told"
        )
    if counts and min(counts.values()) < 4:
        (unit, condition), n = min(counts.items(), key=lambda item: item[1])
        texts.append(f"few episodes: unit {unit} ({condition}) has {n}, one of them for testing")
    lacking = {u: [c for c in population.conditions if (u, c) not in counts] for u in units}
    some = [f"{u} lacks {some(missing)}" for u, missing in lacking.items() if missing]
    if some:
        texts.append(
            f"not every unit was recorded in every condition: {'; '.join(some[:4])}{f'; {len(some) - 4} more units' if len(some) > 4 else ''}"
        )
    return texts
