"""A folder of recordings, described: how files are written, what names and columns are, what looks wrong.

folder ── dialect ── names of files ── columns ── parts ── mapping ── every episode looked at ── Discovery
"""

import re
from collections import Counter
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np

from ...core import Array, ConfigError, DataError, Names, Record, Work, did_you_mean, frozen
from ...core.arrays import Texts
from ..measures import split_header
from ..population import EpisodeKey, Population, Role
from ..readers.csv_folder import ENDINGS, ChannelMapping, csv_files, position, read_csv_folder
from ..readers.tables import Table, stretches
from ..recording import CHECK, some, usable
from ..steps import GAP
from .dialect import TableHead, look_at
from .examine import RULE, EpisodeLook, examine
from .filenames import infer_names, quoted
from .roles import (
    COMMAND,
    UNKNOWN,
    ColumnPart,
    Samples,
    TableColumn,
    describe,
    label_columns,
    propose,
    time_columns,
    time_scale,
)


@dataclass(frozen=True)
class Wanted:
    """What is said about a folder already."""

    measured: Names = ()
    inputs: Names = ()  # as `measured`: names of channels or of columns
    files: str | None = None  # regular expression in place of the one that is found
    period_s: float | None = None  # where there is no column of time


@frozen
class Discovery:
    """What was found in a folder."""

    mapping: Record  # table ``[data.csv]``, with the keys that are not default
    prepare: tuple[Record, ...]  # steps of preparation that the recordings need
    columns: tuple[TableColumn, ...]  # all of them, with their parts
    population: Population  # as the mapping reads it, before preparation
    notes: Texts = field(default_factory=dict)  # what a key of the mapping rests on
    findings: Names = ()  # what looks wrong
    reading: str = ""  # what the first file was taken for


def discover(source: Path, wanted: Wanted = Wanted(), work: Work | None = None, fewest: int = 0) -> Discovery:
    """Describe a folder of tables; an episode needs at least the `fewest` samples."""
    head, alike, strange = _alike(_files(source, wanted.files))
    pattern, other = infer_names(list(alike))
    if wanted.files is None and other is not None:
        raise ConfigError(
            f"Names of files: {some(list(alike), 3)} can be episodes of one unit or units with one recording each; "
            f"choose, --files '{other}' or --files '{pattern}'."
        )
    mapping: Record = {"files": wanted.files or pattern}
    mapping |= head.dialect.model_dump(exclude_defaults=True)
    columns, keys, notes = _columns(source, head, list(alike.values()), wanted.period_s)
    columns = _decided(columns, wanted)
    recorded = (c for c in columns if c.part not in (ColumnPart.TIME, ColumnPart.LEFT_OUT))
    mapping |= {**keys, "channel": [_channel(c) for c in recorded]}
    damaged = Texts()
    population = read_csv_folder(source, mapping | _exclusion(list(strange)), damaged=damaged)
    alone = f"{len(strange)} files are not like the others and left alone: {some(list(strange))}"
    findings = [f"{alone}; the first {next(iter(strange.values()))}"] if strange else []
    findings += [f"left out, {name}: {why}" for name, why in damaged.items()]
    findings += _doubted(columns, keys.get("time_scale", 1.0), notes)
    unused = [name for name in (*strange, *damaged) if re.search(mapping["files"], name)]
    draft = Discovery(mapping, (), tuple(columns), population, notes, tuple(findings))
    found = _examined(source, draft, unused, fewest, work)
    retained = read_csv_folder(source, found.mapping)
    return replace(found, population=retained, reading=_reading(retained, source))


def _files(source: Path, expression: str | None) -> dict[str, Path]:
    """Return the tables below a folder by their relative paths, those that the expression selects."""
    try:
        selects = re.compile(expression or "").search
    except re.error as error:
        raise ConfigError(f"--files {expression!r}: is not a regular expression ({error}); correct it.") from error
    files = csv_files(source)
    selected = {relative: path for relative, path in files.items() if selects(relative)}
    if not selected:
        problem = f"none of {len(files)} files of recordings matches --files {expression!r}; correct the expression"
        if not files:
            problem = f"there are no files of recordings ({', '.join(ENDINGS)}); save CSV, or use kros.from_frame"
        raise DataError(f"Looking at {source}: {problem}.")
    return selected


def _alike(files: dict[str, Path]) -> tuple[TableHead, dict[str, Table], Texts]:
    """Return how most files are written, those files, and what is different in the others."""
    paths, heads = list(files.values()), []
    for path in paths[:: max(1, len(paths) // RULE.looked_at)]:
        with suppress(DataError):
            heads.append(look_at(path))
    if not heads:
        raise DataError(f"Looking at {paths[0].parent}: no file looked at holds rows of numbers; check the folder.")
    commonest = Counter((h.dialect, h.fields) for h in heads).most_common(1)[0][0]
    usual = (h for h in heads if (h.dialect, h.fields) == commonest)
    head = max(usual, key=lambda h: sum(map(h.is_numeric, range(len(h.fields)))))  # a sensor may have been off
    alike, strange = {}, {}
    for relative, path in files.items():
        try:
            table = Table.open(path, head.dialect, head.fields)
        except DataError as error:
            strange[relative] = f"cannot be read ({error})"
            continue
        names, needed = ({split_header(name)[0] for name in of} for of in (table.fields, head.fields))
        if needed - {""} <= names if head.dialect.header else len(table.fields) == len(head.fields):
            alike[relative] = table
        else:
            strange[relative] = f"has the columns {list(table.fields)}"
    return head, alike, strange


def _columns(
    source: Path, head: TableHead, tables: Sequence[Table], period_s: float | None
) -> tuple[list[TableColumn], Record, Texts]:
    """Return the columns with the parts that are proposed, the keys that say what time is, and what these rest on."""
    columns = describe(head)
    numeric = [c for c in columns if head.is_numeric(c.at)]
    table, samples = _sampled(source, tables, numeric)
    candidates, labels = time_columns(numeric, samples), {}
    if period_s is None and not candidates:
        labels = label_columns(table)  # of several episodes in a file
    if labels:
        texts = [table.texts(table.fields.index(label)) for label in labels.values()]
        episodes = [rows for _, rows in stretches(texts)][: RULE.sampled]
        samples = {at: [signals[0][rows] for rows in episodes] for at, signals in samples.items()}
        candidates = time_columns(numeric, samples)
    known, keys, notes = dict[int, TableColumn](), Record(sample_period_s=period_s), Texts()
    if period_s is None:
        time, keys, notes = _time(source, head, columns, candidates, samples)
        known[time.at] = replace(time, part=ColumnPart.TIME)
    keys |= {"labels": labels} if labels else {}
    why = "says which unit, condition or episode a row belongs to"
    known |= {c.at: replace(c, why=why) for c in columns if c.header in labels.values()}
    known |= {c.at: c for c in propose([c for c in numeric if c.at not in known], samples)}
    return [known.get(c.at, replace(c, why="no numbers")) for c in columns], keys, notes


def _sampled(source: Path, tables: Sequence[Table], columns: Sequence[TableColumn]) -> tuple[Table, Samples]:
    """Return the first table that can be read, and columns of some that can; what cannot be used is NaN."""
    spread = tables[:: max(1, len(tables) // RULE.sampled)]
    places, samples = [c.at for c in columns], dict[Table, Array]()
    for table in dict.fromkeys((*spread, *tables)):
        if len(samples) == len(spread):
            break
        with suppress(DataError):
            values = table.numbers([position(table, c.reference, c.recorded) for c in columns])
            if len(values) >= CHECK.samples:
                known = np.where(usable(values), values, np.inf)
                first = np.append(True, (known[1:] != known[:-1]).any(axis=1))  # the others repeat the row before
                samples[table] = np.where(np.isfinite(known), known, np.nan)[first].T
    if not samples:
        tables[0].numbers(places)  # says why not, where it cannot be read
        raise DataError(f"Looking at {source}: the files have fewer than three rows of numbers; check the folder.")
    return next(iter(samples)), {at: [signals[i] for signals in samples.values()] for i, at in enumerate(places)}


def _time(
    source: Path, head: TableHead, columns: Sequence[TableColumn], candidates: Sequence[TableColumn], samples: Samples
) -> tuple[TableColumn, Record, Texts]:
    """Return the column of time, the keys of a mapping that describe it, and what they rest on."""
    stamps = {c: head.timestamp(c.at) for c in columns}
    texts = [c for c, order in stamps.items() if order is not None]
    if candidates and (not texts or candidates[0].kind == "time"):
        time = candidates[0]
        keys: Record = {"time": time.reference}
        if time.unit == "s":
            return time, keys, {}
        scale, why = time_scale(float(np.median(np.diff(samples[time.at][0]))))
        return time, keys | {"time_scale": scale}, {"time_scale": why}
    if texts:
        return texts[-1], {"time": texts[-1].reference, "timestamp": stamps[texts[-1]]}, {}
    called = next((c.header for c in columns if c.kind == "time"), None)
    problem = f"{called!r} stands still or runs back in places, as rounded times do" if called else "no column is time"
    found = ", ".join(repr(c.header) for c in columns)
    raise DataError(f"Looking at {source}: {problem}, found {found}; give --period SECONDS, or name labels.")


def _channel(column: TableColumn) -> Record:
    """Return the table ``[[channel]]`` of a column, with the keys that are not default."""
    role, measured = Role.INPUT if column.part is ColumnPart.INPUT else Role.STATE, column.part is ColumnPart.MEASURED
    named = {} if column.reference == column.name else {"column": column.reference}
    about = {"unit": column.unit, "column_unit": column.recorded, "scale": column.scale, "offset": column.offset}
    channel = ChannelMapping(name=column.name, role=role, measured=measured, **named, **about)
    return channel.model_dump(mode="json", exclude_defaults=True)


def _decided(columns: Sequence[TableColumn], wanted: Wanted) -> list[TableColumn]:
    """Return the columns with measured states and inputs as named, where any are named, else as proposed."""
    measured, given, decided = ColumnPart.MEASURED, ColumnPart.INPUT, []
    freed = {measured: ColumnPart.STATE, given: ColumnPart.LEFT_OUT}
    named = {
        measured: [_named(columns, n) for n in wanted.measured],
        given: [_named(columns, n) for n in wanted.inputs],
    }
    for column in columns:
        parts = [part for part, of in named.items() if column in of]
        if parts[1:]:
            raise ConfigError(f"Roles: --measured and --input both name {column.name!r}; name it in one of them.")
        part = freed[column.part] if named.get(column.part) else column.part
        decided.append(replace(column, part=parts[0], why="as named") if parts else replace(column, part=part))
    for part, what, option in ((measured, "a measured state", "--measured"), (given, "an input", "--input")):
        if not any(c.part is part for c in decided):
            problem = f"no column is {what} by its name; name it, {option} NAME"
            known = _names([c for c in decided if c.part is not ColumnPart.TIME])
            raise ConfigError(f"Roles: {problem}. The columns are {known}.")
    if any(c.part is ColumnPart.STATE for c in decided):
        return decided
    return [replace(c, part=ColumnPart.STATE) if c.why == UNKNOWN else c for c in decided]  # to be estimated


def _doubted(columns: Sequence[TableColumn], time_scale: float, notes: Mapping[str, str]) -> list[str]:
    """Return sentences about a guessed unit of time other than seconds, and about columns that are left out."""
    guess = [f"time_scale = {time_scale:g}: {notes['time_scale']}"] if time_scale != 1 else []
    if unknown := [c for c in columns if c.part is ColumnPart.LEFT_OUT and c.why in (COMMAND, UNKNOWN)]:
        guess.append(f"columns that move, left out: {_names(unknown)}; name an --input or --measured")
    return guess


def _named(columns: Sequence[TableColumn], name: str) -> TableColumn:
    """Return a column by the name of its channel, else by its header."""
    free = [c for c in columns if c.part is not ColumnPart.TIME]
    for column in (*(c for c in free if c.name == name), *(c for c in free if c.header == name)):
        return column
    hint = did_you_mean(name, [c.name for c in free])
    raise ConfigError(f"Roles: there is no column {name!r}{hint} beside time there are {_names(free)}.")


def _names(columns: Sequence[TableColumn]) -> str:
    """Return the names of channels, with their headers where these are others."""
    return ", ".join(c.name if c.name == c.header else f"{c.name} ({c.header!r})" for c in columns)


def _examined(source: Path, draft: Discovery, excluded: Sequence[str], fewest: int, work: Work | None) -> Discovery:
    """Look at every episode, leave out what cannot be used, and complete the description."""
    population, mapping, notes, findings = draft.population, draft.mapping, dict(draft.notes), [*draft.findings]
    looks = examine(population, fewest, work or Work())
    wrong, good = {s.key: s.wrong for s in looks if s.wrong}, [s for s in looks if not s.wrong]
    counts = Counter((s.key.unit, s.key.condition) for s in good)
    if not counts:
        raise DataError(f"Looking at {source}: none of {len(looks)} episodes can be used; {looks[0].wrong}")
    files = _files_of(population, source)
    findings += [f"left out, {files[key]}: {why}" for key, why in wrong.items()]
    usual = np.median([s.n_samples for s in good])
    short = {s: f"of {s.n_samples + s.lost}, the rest is behind a gap" for s in good if s.lost}
    short |= {s: f"most have {usual:.0f}" for s in good if CHECK.ratio * s.n_samples < usual}
    findings += [f"{files[s.key]}: {s.n_samples} samples are used, {why}" for s, why in short.items()]
    few, shortest = [group for group, n in counts.items() if n < 2], min(s.n_samples for s in good)
    if 2 * len(few) > len(counts) and shortest >= 2 * fewest:
        mapping = mapping | {"pieces": int(np.clip(shortest // RULE.shortest_piece, 2, RULE.pieces))}
        notes["pieces"] = "there is one recording for most units and conditions: each is cut into so many episodes"
        few = []
    if len(few) == len(counts):
        needs = f"two are needed, of {fewest} samples each; record more, or name files (--files)"
        raise DataError(f"Looking at {source}: every unit has one episode that can be used, and {needs}.")
    for unit, condition in few:
        wrong |= dict.fromkeys(population.keys(unit, condition), "the only episode of its unit and condition")
        findings.append(f"left out, unit {unit} ({condition}) has 1 episode that can be used, and two are needed")
    mapping = mapping | _exclusion([*excluded, *(files[key] for key in wrong)])
    prepare, text = _resampling(files, good)
    return replace(draft, mapping=mapping, prepare=prepare, notes=notes, findings=(*findings, *text))


def _resampling(files: Mapping[EpisodeKey, str], looks: Sequence[EpisodeLook]) -> tuple[tuple[Record, ...], list[str]]:
    """Return the step that makes time even or bridges NaN, and a sentence about it; nothing where neither is needed."""
    median, worst = float(np.median([s.period_s for s in looks])), max(looks, key=lambda s: s.uneven)
    period_s, nan = float(f"{median:.3g}"), sum(s.nan for s in looks)
    differ = worst.uneven[0] > CHECK.time or any(abs(s.period_s - median) > CHECK.period * median for s in looks)
    if not (differ or nan):
        return (), []
    text = f"NaN in {nan} episodes is bridged by straight lines"
    if differ:
        ends = " to ".join(dict.fromkeys(f"{end(s.period_s for s in looks):.4g}" for end in (min, max)))
        where = f"by {worst.uneven[0] * period_s:.3g} s at sample {worst.uneven[1]} of {files[worst.key]}"
        text = f"time is uneven, or periods differ (recorded at {ends} s), the worst step differs {where}"
    text += f"; all episodes are resampled to a period of {period_s:g} s"
    text += f"; where a step is longer than {GAP:g} periods, the longest stretch without such a gap is taken"
    return ({"step": "resample", "period_s": period_s},), [text]


def _reading(population: Population, source: Path) -> str:
    """Return what the path of the first episode was taken for."""
    key, groups = population.episodes[0], sorted({unit.group for unit in population.units if unit.group})
    group = f", group {population.unit(key.unit).group!r} of {some(groups)}" if groups else ""
    parts = f"unit {key.unit!r}, condition {key.condition!r}, episode {key.episode!r}{group}"
    return f"{_files_of(population, source)[key]}: {parts}"


def _exclusion(names: Sequence[str]) -> Record:
    return {"exclude": f"^(?:{'|'.join(quoted(name) for name in dict.fromkeys(names))})$"} if names else {}


def _files_of(population: Population, source: Path) -> dict[EpisodeKey, str]:
    """Return the file of every episode, relative to the folder."""
    places = population.source.recordings.places
    return {key: places[key].table.path.relative_to(source).as_posix() for key in population.episodes}
