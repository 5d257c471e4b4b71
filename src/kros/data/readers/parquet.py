"""The native format: `population.json` and one Parquet file per unit and condition, one row group an episode."""

from __future__ import annotations

import sys
from collections import OrderedDict
from collections.abc import Callable, Hashable, Iterable, Mapping
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from threading import Lock
from typing import Any

import numpy as np
import numpy.typing as npt

from ...core import limits
from ...core.artifacts import load_artifact
from ...core.errors import DataError
from ...core.files import pass_on_shortage, require_regular, shortened
from ..arrow import fill
from ..checks import check_period
from ..population import Channel, EpisodeKey, Population, Role, Unit, columns_in_order
from ..prepare import assemble
from ..recording import Recording, Recordings
from ..scaling import Scaling

INDEX = "population"  # kind of the artifact, hence population.json
KEYS = ("unit", "condition", "episode")
AGAIN = "convert the recordings again"
Array = npt.NDArray[np.float64]
Version = tuple[int, int, int]
Place = tuple[str, int, int]
_ARROW_ERRORS = (OSError, ValueError, LookupError, TypeError, ArithmeticError, NotImplementedError, MemoryError)


class Kept:
    """Read-only arrays by key, the latest asked for, at most so many bytes in all."""

    def __init__(self, limit: int) -> None:
        self.limit, self.size = limit, 0
        self.arrays: OrderedDict[Hashable, Array] = OrderedDict()
        self._lock = Lock()

    def take(self, key: Hashable, make: Callable[[], Array]) -> Array:
        """Return the array of a key, made where it is not there."""
        with self._lock:
            if key in self.arrays:
                self.arrays.move_to_end(key)
                return self.arrays[key]
        array = make()
        array.flags.writeable = False
        with self._lock:
            if array.nbytes <= self.limit and key not in self.arrays:
                self.arrays[key] = array
                self.size += array.nbytes
            while self.size > self.limit:
                self.size -= self.arrays.popitem(last=False)[1].nbytes
        return array


_KEPT = Kept(limit=2**28)  # the demo's recordings fit, those of a factory do not have to


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
        values = _KEPT.take(
            (str(path), version, place, key, self.columns), lambda: self._values(key, path, version, place)
        )
        return Recording(key, values)

    def _values(self, key: EpisodeKey, path: Path, version: Version, place: Place) -> Array:
        """Return the samples of an episode from its file."""
        try:
            table = _read_group(path, version, place, [*KEYS, *self.columns])
            values = np.empty((table.num_rows, len(self.columns)))
            for column, channel in enumerate(self.columns):
                fill(values[:, column], table.column(channel))
            table.select(KEYS).validate(full=True)
            for name in KEYS:
                expected, actual = getattr(key, name), table.column(name).unique().to_pylist()
                _require(actual == [expected], path, f"the index says {name} {expected!r}, the samples say {actual!r}")
            return values
        except DataError:
            raise
        except _ARROW_ERRORS as error:
            pass_on_shortage(error, path)
            raise DataError(f"Reading {key} from {path}: {shortened(str(error))}; {AGAIN}.") from error


@lru_cache(maxsize=64)
def _metadata(path: Path, version: Version) -> Any:
    """Return what a file says of all its row groups, which are asked for one by one."""
    from pyarrow import parquet

    return parquet.read_metadata(path)


def _read_group(path: Path, version: Version, place: Place, columns: list[str]) -> Any:
    """Read one row group after its length and the types of its columns, pages against their checksums."""
    from pyarrow import parquet

    _, group, samples = place
    options: dict[str, Any] = {"memory_map": True, "pre_buffer": False, "page_checksum_verification": True}
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
        return file.read_row_group(group, columns=columns, use_threads=False)


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
