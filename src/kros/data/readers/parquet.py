"""kros's native format, both ways: `population.json` and a Parquet file per unit and condition.

    <folder>/population.json                 channels, period, units, episodes with their lengths
    <folder>/<unit>@<condition>.parquet      one row group an episode: unit, condition, episode, k, then the channels
                                             and truths

Names of files are percent-encoded, so any id works. A study writes groups from several processes (`write_group`),
then the index.
"""

import sys
from collections.abc import Iterable, Iterator
from dataclasses import astuple, field, replace
from functools import lru_cache
from hashlib import sha256
from pathlib import Path
from typing import Any
from urllib.parse import quote

import numpy as np

from ...core import Array, DataError, Names, Record, Storable, frozen
from ...core.artifacts import as_written
from ...core.files import draft_beside, pass_on_shortage, require_regular, shortened, stamp_of, whole_folder
from ..population import Channels, EpisodeKey, Population, Scaling, Unit, columns_in_order
from ..prepare import assemble
from ..recording import Recording, Recordings, check_structure, refuse_copies, usable_episodes
from .tables import from_numpy, repeated, to_numpy

Place = tuple[str, int, int]
Episodes = Iterable[tuple[EpisodeKey, Array, str]]  # usable ones, with their samples and digests
INDEX = "population"  # kind of the artifact, hence population.json
KEYS = ("unit", "condition", "episode")
AGAIN = "convert the recordings again"
LONGEST_NAME = 200  # file systems allow 255 bytes


@frozen
class ParquetRecordings(Recordings):
    """Reads one row group at a time; a place is a file, its row group and the number of samples."""

    folder: str
    columns: Names

    def file(self, place: Place) -> Path:
        """Return the file of a unit and condition."""
        return Path(self.folder) / place[0]

    def read(self, key: EpisodeKey) -> Recording:
        """Return an episode, pages against their checksums."""
        from pyarrow import parquet

        place = self.places[key]
        path, (_, group, samples) = self.file(place), place
        options: Record = dict.fromkeys(("page_checksum_verification", "memory_map"), True) | {"read_dictionary": KEYS}
        require_regular(path, sys.maxsize)
        try:
            with parquet.ParquetFile(path, metadata=_metadata(path, stamp_of(path)), **options) as file:
                table = file.read_row_group(group, columns=[*KEYS, *self.columns], use_threads=False)
            table.select(KEYS).validate(full=True)
            chunks = [table.column(name).combine_chunks() for name in KEYS]
            labels = [[*chunk.dictionary.to_pylist(), *[None] * chunk.null_count] for chunk in chunks]
            types = {str(table.schema.field(name).type) for name in self.columns}
            if (labels, types, len(table)) != ([[name] for name in astuple(key)], {"double"}, samples):
                raise DataError(
                    f"Reading {path}: row group {group} should hold {samples} samples of {key} as double, found "
                    f"{len(table)} of {labels} as {', '.join(types)}; files were changed, {AGAIN}."
                )
            return Recording(key, np.stack([to_numpy(table.column(channel)) for channel in self.columns]).T)
        except DataError:
            raise
        except Exception as error:  # what damaged files raise has no common base
            pass_on_shortage(error, path)
            raise DataError(f"Reading {key} from {path}: {shortened(str(error))}; {AGAIN}.") from error


@lru_cache
def _metadata(path: Path, version: tuple[int, int]) -> Any:
    """Return the description of all row groups of a file, which are read one by one."""
    from pyarrow import parquet

    return parquet.read_metadata(path)


def read_parquet(folder: Path | str) -> Population:
    """Read a population that `write_parquet` wrote.

    Parameters
    ----------
    folder : Path or str
        Holds ``population.json``.

    Returns
    -------
    Population
        Lazy: only ``population.json`` is read at once.

    Raises
    ------
    DataError
        When there is no population, or one of another schema.

    Examples
    --------
    >>> from tempfile import TemporaryDirectory
    >>> import numpy as np
    >>> import kros
    >>> names = {"states": ["x"], "measured": ["x"], "inputs": ["u"]}
    >>> population = kros.from_arrays({"a": [np.eye(5, 2)]}, sample_period_s=0.01, **names)
    >>> with TemporaryDirectory() as folder:
    ...     kros.data.write_parquet(population, f"{folder}/recordings")
    ...     kros.data.read_parquet(f"{folder}/recordings").unit_ids
    ('a',)
    """
    folder = Path(folder)
    index = PopulationIndex.load(folder)
    with as_written("population", folder):
        places = _places(index.groups)
    missing = sorted({name for name, _, _ in places.values() if not (folder / name).is_file()})
    if missing:
        raise DataError(f"Reading {folder}: {len(missing)} files are missing, the first {missing[0]}; {AGAIN}.")
    channels = columns_in_order((*index.channels, *index.truths))
    recordings = ParquetRecordings(places, str(folder), tuple(c.name for c in channels))
    return assemble(recordings, channels, index.units, index.sample_period_s, index.metadata, scaling=index.scaling)


@frozen
class GroupRecord:
    """What `write_group` wrote: one unit in one condition."""

    unit: str
    condition: str
    file: str
    episodes: Names  # in the order of the row groups
    samples: tuple[int, ...]  # length of each episode
    digests: Names = ()  # of all samples of each episode

    @property
    def keys(self) -> list[EpisodeKey]:
        """Keys of the episodes."""
        return [EpisodeKey(self.unit, self.condition, episode) for episode in self.episodes]


@frozen
class PopulationIndex(Storable):
    """Content of `population.json`."""

    KIND = INDEX
    sample_period_s: float
    channels: Channels
    units: tuple[Unit, ...]
    metadata: Record
    groups: tuple[GroupRecord, ...]
    truths: Channels = ()
    scaling: dict[str, Scaling] = field(default_factory=dict)


def _places(groups: Iterable[GroupRecord]) -> dict[EpisodeKey, Place]:
    """Return where every episode is."""
    places = {}
    for g in groups:
        if g.file in ("", ".", "..") or Path(g.file).name != g.file:
            raise ValueError(f"the file {g.file!r} is not beside the index")
        for row_group, (key, samples) in enumerate(zip(g.keys, g.samples, strict=True)):
            if key in places:
                raise ValueError(f"{key} occurs twice")
            places[key] = g.file, row_group, samples
    return places


def write_group(population: Population, folder: Path, episodes: Episodes) -> GroupRecord:
    """Write the episodes of a population that is one unit in one condition."""
    ((unit, condition, _),) = population.groups()
    name = group_file(unit, condition)
    with draft_beside(folder) as draft:
        episode_names, samples, digests = zip(*_write_episodes(population, episodes, draft), strict=True)
        draft.replace(folder / name)
    return GroupRecord(unit, condition, name, episode_names, samples, digests)


def group_file(unit: str, condition: str) -> str:
    """Return the name of the file of one unit and condition; different ids never share a name."""
    name = f"{quote(unit, safe='')}@{quote(condition, safe='')}"
    if len(name) > LONGEST_NAME:
        digest = f"~{sha256(name.encode()).hexdigest()}"
        name = name[: LONGEST_NAME - len(digest)] + digest
    return f"{name}.parquet"


def _write_episodes(population: Population, episodes: Episodes, path: Path) -> Iterator[tuple[str, int, str]]:
    """Write usable episodes one behind the other; yield episode, number of samples and digest."""
    import pyarrow as pa
    from pyarrow import parquet

    names = [c.name for c in population.columns]
    if clash := sorted({*KEYS, "k"} & set(names)):
        raise DataError(f"Writing Parquet: channels {clash} have names of the columns of keys; rename them.")
    kinds = dict.fromkeys(KEYS, pa.dictionary(pa.int32(), pa.string())) | {"k": pa.int64()}
    schema = pa.schema(kinds | dict.fromkeys(names, pa.float64()))
    # Bytes of equal weight side by side, then LZ4: 57 % of the size for 0.03 s per 91 MB; zstd: 55 %, 0.08 s.
    options: Record = {
        "column_encoding": {"k": "DELTA_BINARY_PACKED", **dict.fromkeys(names, "BYTE_STREAM_SPLIT")},
        "compression": "lz4",
        "use_dictionary": list(KEYS),
        "write_statistics": False,
        "write_page_checksum": True,
    }
    with parquet.ParquetWriter(path, schema, **options) as writer:
        for key, values, digest in episodes:
            n = len(values)
            signals = [from_numpy(column) for column in (np.arange(n, dtype=np.int64), *values.T)]
            arrays = [*(repeated(getattr(key, name), n) for name in KEYS), *signals]
            writer.write_table(pa.Table.from_arrays(arrays, schema=schema), row_group_size=n)
            yield key.episode, n, digest


def write_index(population: Population, records: Iterable[GroupRecord], folder: Path, converted: bool = True) -> None:
    """Write `population.json` for groups that were written; where they are `converted`, they are new recordings."""
    groups, scaling = tuple(records), dict(population.scaling)
    check_structure(population.columns, [key for g in groups for key in g.keys])
    refuse_copies(pair for g in groups for pair in zip(g.keys, g.digests, strict=bool(g.digests)))
    if converted:
        scaling = {name: replace(scale, converted=scale.factor) for name, scale in scaling.items()}
    facts = (population.sample_period_s, population.channels, population.units, dict(population.metadata))
    index = PopulationIndex(*facts, tuple(replace(g, digests=()) for g in groups), population.truths, scaling)
    index.save(folder)


def write_parquet(population: Population, out: Path | str, converted: bool = True) -> None:
    """Write a population as a folder of Parquet files; it appears whole or not at all.

    Parameters
    ----------
    population : Population
    out : Path
        Folder to make.
    converted : bool
        Whether the files are new recordings, in the channels' units; False where they stand for those that were read.

    Raises
    ------
    DataError
        `out` exists, or an episode cannot be used.

    Examples
    --------
    >>> from pathlib import Path
    >>> from tempfile import TemporaryDirectory
    >>> import numpy as np
    >>> import kros
    >>> names = {"states": ["x"], "measured": ["x"], "inputs": ["u"]}
    >>> population = kros.from_arrays({"a": [np.eye(5, 2)]}, sample_period_s=0.01, **names)
    >>> with TemporaryDirectory() as folder:
    ...     kros.data.write_parquet(population, f"{folder}/recordings")
    ...     print(sorted(path.name for path in Path(folder, "recordings").iterdir()))
    ['a@default.parquet', 'population.json']
    """
    with whole_folder(Path(out)) as folder:
        groups = [population.select([unit], [condition]) for unit, condition, _ in population.groups()]
        records = [write_group(group, folder, usable_episodes(group)) for group in groups]
        write_index(population, records, folder, converted)
