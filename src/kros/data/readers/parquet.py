"""kros's native format, both ways: `population.json` and a Parquet file per unit and condition.

    <folder>/population.json                 channels, period, units, episodes with their lengths
    <folder>/<unit>@<condition>.parquet      one row group an episode: unit, condition, episode, k, then the channels
                                             and truths

Names of files are percent-encoded, so any id works. A study writes groups from several processes (`write_group`),
then the index.
"""

from __future__ import annotations

import logging
import os
import sys
from collections import OrderedDict
from collections.abc import Callable, Hashable, Iterable, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from functools import lru_cache
from hashlib import sha256
from pathlib import Path
from threading import Lock
from typing import Any, TypeVar
from urllib.parse import quote

import numpy as np
import numpy.typing as npt

from ...core import limits
from ...core.artifacts import load_artifact, save_artifact
from ...core.errors import DataError
from ...core.files import pass_on_shortage, require_regular, shortened, whole_folder
from ..arrow import fill, from_numpy, repeated
from ..checks import Look, check_period, check_structure, refuse_copies, usable_episodes
from ..population import Channel, EpisodeKey, Population, Role, Scaling, Unit, columns_in_order
from ..prepare import assemble
from ..recording import Recording, Recordings
from .tables import BLOCK

logger = logging.getLogger(__name__)

T = TypeVar("T")
Array = npt.NDArray[np.float64]
Version = tuple[int, int, int]
Place = tuple[str, int, int]
INDEX = "population"  # kind of the artifact, hence population.json
KEYS = ("unit", "condition", "episode")
AGAIN = "convert the recordings again"
LONGEST_NAME = 200  # file systems allow 255 bytes, and a temporary name is longer
# Signals as bytes of equal weight side by side, then LZ4: 57 % of the size for 0.03 s per 91 MB; zstd: 55 %, 0.08 s.
COMPRESSION, SIGNALS, COUNTER = "lz4", "BYTE_STREAM_SPLIT", "DELTA_BINARY_PACKED"
_ARROW_ERRORS = (OSError, ValueError, LookupError, TypeError, ArithmeticError, NotImplementedError, MemoryError)
_INDEXED = ("unit", "condition", "file", "episodes", "samples")


class ArrayCache:
    """Read-only arrays by key, the latest asked for, at most so many bytes in all."""

    def __init__(self, limit: int) -> None:
        self.limit, self.size = limit, 0
        self.arrays: OrderedDict[Hashable, Array] = OrderedDict()
        self._lock = Lock()

    def take(self, key: Hashable, read: Callable[[], Array]) -> Array:
        """Return the array of a key, read where it is not there."""
        with self._lock:
            if key in self.arrays:
                self.arrays.move_to_end(key)
                return self.arrays[key]
        array = read()
        array.flags.writeable = False
        with self._lock:
            if array.nbytes <= self.limit and key not in self.arrays:
                self.arrays[key] = array
                self.size += array.nbytes
            while self.size > self.limit:
                self.size -= self.arrays.popitem(last=False)[1].nbytes
        return array


_CACHE = ArrayCache(limit=2**28)  # the demo's recordings fit, those of a factory do not have to


@dataclass(frozen=True, eq=False)
class ParquetRecordings(Recordings):
    """Reads one row group at a time; a place is a file, its row group and the number of samples."""

    folder: str
    columns: tuple[str, ...]

    def file(self, place: Place) -> Path:
        """Return the file of a unit and condition."""
        return Path(self.folder) / place[0]

    def read(self, key: EpisodeKey, place: Place) -> Recording:
        """Return one episode."""
        path = self.file(place)
        require_regular(path, sys.maxsize)
        status = path.stat()
        version = (status.st_ino, status.st_size, status.st_mtime_ns)  # a file written anew is read anew
        known_by = (str(path), version, place, key, self.columns)
        return Recording(key, _CACHE.take(known_by, lambda: next(self._values(key, path, version, place))))

    def blocks(self, key: EpisodeKey, rows: int) -> Iterator[Array]:
        """Return the samples of an episode in blocks, read one after the other."""
        path, status = self.file(self.places[key]), self.file(self.places[key]).stat()
        return self._values(key, path, (status.st_ino, status.st_size, status.st_mtime_ns), self.places[key], rows)

    def _values(
        self, key: EpisodeKey, path: Path, version: Version, place: Place, rows: int | None = None
    ) -> Iterator[Array]:
        """Return the samples of an episode from its file, whole or in blocks."""
        try:
            for table in _read_group(path, version, place, [*KEYS, *self.columns], rows):
                values = np.empty((table.num_rows, len(self.columns)))
                for column, channel in enumerate(self.columns):
                    fill(values[:, column], table.column(channel))
                table.select(KEYS).validate(full=True)
                for name in KEYS:
                    wanted, actual = getattr(key, name), table.column(name).unique().to_pylist()
                    _require(actual == [wanted], path, f"the index says {name} {wanted!r}, the samples say {actual!r}")
                yield values
        except DataError:
            raise
        except _ARROW_ERRORS as error:
            pass_on_shortage(error, path)
            raise DataError(f"Reading {key} from {path}: {shortened(str(error))}; {AGAIN}.") from error


@lru_cache(maxsize=64)
def _metadata(path: Path, version: Version) -> Any:
    """Return the description of all row groups of a file, which are read one by one."""
    from pyarrow import parquet

    return parquet.read_metadata(path)


def _read_group(path: Path, version: Version, place: Place, columns: list[str], rows: int | None) -> Iterator[Any]:
    """Read one row group, perhaps in blocks, after its length and the types of its columns, pages against checksums."""
    import pyarrow as pa
    from pyarrow import parquet

    _, group, samples = place
    options: dict[str, Any] = {"pre_buffer": False, "page_checksum_verification": True}
    options |= {"memory_map": True} if rows is None else {"buffer_size": BLOCK}
    with parquet.ParquetFile(path, metadata=_metadata(path, version), **options) as file:
        actual = file.metadata.row_group(group).num_rows
        _require(actual == samples, path, f"{samples} samples are expected in row group {group}, found {actual}")
        if samples > limits.MAX_SAMPLES:
            advice = "cut it, or raise MAX_SAMPLES in kros.core.limits"
            raise DataError(f"Reading {path}: an episode has {samples} samples; {advice}.")
        for name in columns:
            kind, wanted = str(file.schema_arrow.field(name).type), "text" if name in KEYS else "numbers of type double"
            fits = "string" in kind if name in KEYS else kind == "double"
            _require(fits, path, f"column {name!r} should hold {wanted}, found {kind}")
        if rows is None:
            yield file.read_row_group(group, columns=columns, use_threads=False)
            return
        for part in file.iter_batches(rows, row_groups=[group], columns=columns, use_threads=False):
            yield pa.Table.from_batches([part])


def _require(condition: bool, path: Path, problem: str) -> None:
    if not condition:
        raise DataError(f"Reading {path}: {shortened(problem)}; files were changed, {AGAIN}.")


def read_parquet(folder: Path | str) -> Population:
    """Read a population that `write_parquet` wrote.

    Parameters
    ----------
    folder : Path
        Holds `population.json`.

    Returns
    -------
    Population
        Lazy: only `population.json` is read.

    Raises
    ------
    DataError
        No population there, or one of another schema.

    Examples
    --------
    >>> from tempfile import TemporaryDirectory
    >>> import numpy as np
    >>> import kros
    >>> names = {"states": ["x"], "measured": ["x"], "inputs": ["u"]}
    >>> population = kros.from_arrays({"a": [np.eye(5, 2)]}, sample_period_s=0.01, **names)
    >>> with TemporaryDirectory() as folder:
    ...     kros.data.write_parquet(population, f"{folder}/recordings")
    ...     print(kros.data.read_parquet(f"{folder}/recordings"))
    Population(1 unit, 1 condition, 1 episode every 0.01 s; states x (measured); inputs u)
    """
    folder = Path(folder)
    content, _ = load_artifact(folder, INDEX)
    what = f"Reading {folder / 'population.json'}"
    try:
        columns = [_channel(c) for c in (*content["channels"], *content.get("truths", ()))]
        units = [Unit(_text(u["id"]), _text(u["group"]), dict(u["metadata"])) for u in content["units"]]
        places = _places(content["groups"])
        period = check_period(content["sample_period_s"], what)
        metadata = dict(content["metadata"])
        scaling = {name: Scaling(**scale) for name, scale in content.get("scaling", {}).items()}
    except DataError:
        raise
    except (LookupError, TypeError, ValueError, AttributeError) as error:
        raise DataError(f"{what}: not as kros writes it ({error!r}); {AGAIN}.") from error
    missing = sorted({name for name, _, _ in places.values() if not (folder / name).is_file()})
    if missing:
        raise DataError(f"Reading {folder}: {len(missing)} files are missing, the first {missing[0]}; {AGAIN}.")
    channels = columns_in_order(columns)
    recordings = ParquetRecordings(places, str(folder), tuple(c.name for c in channels))
    return assemble(recordings, channels, units, period, metadata, scaling=scaling)


def _channel(row: Mapping[str, Any]) -> Channel:
    """Return a channel of the index."""
    of = _text(row.get("of", ""))
    return Channel(_text(row["name"]), Role(row["role"]), _text(row["unit"]), row.get("measured") is True, of)


def _places(groups: Iterable[Mapping[str, Any]]) -> dict[EpisodeKey, Place]:
    """Return where every episode is."""
    places: dict[EpisodeKey, Place] = {}
    for g in groups:
        unit, condition, name = _text(g["unit"]), _text(g["condition"]), _text(g["file"])
        if name in ("", ".", "..") or Path(name).name != name:
            raise ValueError(f"the file {name!r} is not beside the index")
        for row_group, (episode, samples) in enumerate(zip(g["episodes"], g["samples"], strict=True)):
            key = EpisodeKey(unit, condition, _text(episode))
            if key in places:
                raise ValueError(f"{key} occurs twice")
            if type(samples) is not int or samples < 0:
                raise TypeError(f"{samples!r} is no number of samples")
            places[key] = name, row_group, samples
    return places


def _text(value: Any) -> str:
    if not isinstance(value, str):
        raise TypeError(f"{value!r} should be text")
    return value


@dataclass(frozen=True)
class GroupRecord:
    """What `write_group` wrote: one unit in one condition."""

    unit: str
    condition: str
    file: str = ""
    episodes: tuple[str, ...] = ()  # in the order of the row groups
    samples: tuple[int, ...] = ()  # length of each episode
    digests: tuple[str, ...] = ()  # of all samples of each episode

    @property
    def recognised(self) -> list[tuple[EpisodeKey, str]]:
        """Episodes with their digests."""
        keys = [EpisodeKey(self.unit, self.condition, episode) for episode in self.episodes]
        return list(zip(keys, self.digests, strict=True)) if self.digests else []


def write_group(
    population: Population,
    unit: str,
    condition: str,
    folder: Path | str,
    on_nan: str = "error",
    look: Look | None = None,
) -> GroupRecord:
    """Read, prepare, check and write all episodes of one unit and condition."""
    keys = population.keys(unit, condition)
    if not keys:
        raise DataError(f"Asked to write unit {unit} ({condition}); the population has no episode of it.")
    path = Path(folder) / group_file(unit, condition)
    temporary = path.with_name(f".{path.name}.{os.getpid()}")
    try:
        written = list(_write_episodes(population, keys, temporary, on_nan, look))
        if not written:
            text = "Unit %s (%s) is left out: no episode of %d is left after dropping those with NaN."
            logger.warning(text, unit, condition, len(keys))
            return GroupRecord(unit, condition)
        temporary.replace(path)
    finally:
        temporary.unlink(missing_ok=True)
    episodes, samples, digests = zip(*written, strict=True)
    return GroupRecord(unit, condition, path.name, episodes, samples, digests)


def group_file(unit: str, condition: str) -> str:
    """Return the name of the file of one unit and condition; different ids never share a name."""
    name = f"{quote(unit, safe='')}@{quote(condition, safe='')}"
    if len(name) > LONGEST_NAME:
        name = f"{name[: LONGEST_NAME - 65]}~{sha256(name.encode()).hexdigest()}"
    return f"{name}.parquet"


def _write_episodes(
    population: Population, keys: Sequence[EpisodeKey], path: Path, on_nan: str, look: Look | None
) -> Iterator[tuple[str, int, str]]:
    """Write usable episodes one behind the other; yield episode, number of samples and digest."""
    import pyarrow as pa
    from pyarrow import parquet

    names = [c.name for c in population.columns]
    if clash := sorted({*KEYS, "k"} & set(names)):
        problem = f"channels {clash} have the name of a key column ({', '.join(KEYS)}, k)"
        raise DataError(f"Writing Parquet: {problem}; rename them.")
    kinds = dict.fromkeys(KEYS, pa.dictionary(pa.int32(), pa.string())) | {"k": pa.int64()}
    schema = pa.schema(kinds | dict.fromkeys(names, pa.float64()))
    options: dict[str, Any] = {
        "column_encoding": {"k": COUNTER, **dict.fromkeys(names, SIGNALS)},
        "compression": COMPRESSION,
        "use_dictionary": list(KEYS),
        "write_statistics": False,
        "write_page_checksum": True,
    }
    with parquet.ParquetWriter(path, schema, **options) as writer:
        for key, values, digest in usable_episodes(population, keys, on_nan, look):
            n = len(values)
            signals = [from_numpy(column) for column in (np.arange(n, dtype=np.int64), *values.T)]
            arrays = [*(repeated(getattr(key, name), n) for name in KEYS), *signals]
            writer.write_table(pa.Table.from_arrays(arrays, schema=schema), row_group_size=n)
            yield key.episode, n, digest


def write_index(
    population: Population, records: Iterable[GroupRecord], folder: Path | str, converted: bool = True
) -> None:
    """Write `population.json` for groups that were written; where they are `converted`, they are new recordings."""
    groups = [g for g in records if g.episodes]
    written, scaling = {g.unit for g in groups}, population.scaling
    check_structure(population.columns, [EpisodeKey(g.unit, g.condition, e) for g in groups for e in g.episodes])
    refuse_copies(pair for g in groups for pair in g.recognised)
    if converted:
        scaling = {name: replace(scale, converted=scale.factor) for name, scale in scaling.items()}
    content = {
        "sample_period_s": population.sample_period_s,
        "channels": population.channels,
        "units": [u for u in population.units if u.id in written],
        "metadata": population.metadata,
        **({"truths": population.truths} if population.truths else {}),
        **({"scaling": scaling} if scaling else {}),
        "groups": [{name: getattr(g, name) for name in _INDEXED} for g in groups],
    }
    save_artifact(Path(folder), INDEX, content)


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
        groups = list(population.groups())
        records = in_threads(lambda group: write_group(population, group[0], group[1], folder), groups)
        write_index(population, records, folder, converted)


def in_threads(function: Callable[[Any], T], tasks: Iterable[Any]) -> list[T]:
    """Map a function over tasks in threads, one per processor; what has not begun when one fails is left."""
    with ThreadPoolExecutor(os.cpu_count()) as pool:
        futures = [pool.submit(function, task) for task in tasks]
        try:
            return [future.result() for future in futures]
        finally:
            pool.shutdown(wait=True, cancel_futures=True)
