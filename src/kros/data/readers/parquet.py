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
from ...core.files import require_regular, shortened
from ...core.memory import pass_on_shortage
from ..arrow import fill
from ..checks import check_period
from ..population import Channel, EpisodeKey, Population, Role, TrueChannel, Unit, columns_in_order
from ..prepare import assemble
from ..recording import Recording, Recordings
from ..scaling import Scaling
from ..tables import build

INDEX = "population"  # kind of the artifact, hence population.json
KEYS = ("unit", "condition", "episode")
Version = tuple[int, int, int]


class Kept:
    """Arrays by key, those that were asked for last, at most so many bytes in all; they cannot be written to."""

    def __init__(self, limit: int) -> None:
        self.limit, self.size = limit, 0
        self.arrays: OrderedDict[Hashable, npt.NDArray[np.float64]] = OrderedDict()
        self._lock = Lock()

    def take(self, key: Hashable, make: Callable[[], npt.NDArray[np.float64]]) -> npt.NDArray[np.float64]:
        """Return the array of a key, made where it is not there."""
        with self._lock:
            if key in self.arrays:
                self.arrays.move_to_end(key)
                return self.arrays[key]
        made = make()
        made.flags.writeable = False
        with self._lock:
            if made.nbytes <= self.limit and key not in self.arrays:
                self.arrays[key] = made
                self.size += made.nbytes
            while self.size > self.limit:
                self.size -= self.arrays.popitem(last=False)[1].nbytes
        return made


_KEPT = Kept(limit=2**28)  # the demo's recordings fit, those of a factory do not have to


@dataclass(frozen=True, eq=False)
class ParquetRecordings(Recordings):
    """Reads one row group at a time; a place is a file, its row group and the number of samples."""

    folder: str
    columns: tuple[str, ...]

    def file(self, place: tuple[str, int, int]) -> Path:
        """Return the file of a unit and condition."""
        return Path(self.folder) / place[0]

    def read(self, key: EpisodeKey, place: tuple[str, int, int]) -> Recording:
        """Return one episode."""
        name, group, samples = place
        path = Path(self.folder) / name
        require_regular(path, sys.maxsize)
        file = path.stat()
        version = (file.st_ino, file.st_size, file.st_mtime_ns)  # a file written anew is read anew
        return Recording(
            key,
            _KEPT.take(
                (str(path), version, group, samples, key, self.columns),
                lambda: self._values(key, path, version, group, samples),
            ),
        )

    def _values(
        self, key: EpisodeKey, path: Path, version: Version, group: int, samples: int
    ) -> npt.NDArray[np.float64]:
        """Return the samples of an episode from its file."""
        try:
            table = _read_group(path, version, group, samples, [*KEYS, *self.columns])
            values = np.empty((table.num_rows, len(self.columns)))
            for column, channel in enumerate(self.columns):
                fill(values[:, column], table.column(channel))
            table.select(KEYS).validate(full=True)
            for label, expected in zip(KEYS, (key.unit, key.condition, key.episode), strict=True):
                _check_label(table.column(label), label, expected, path)
        except DataError:
            raise
        except (
            OSError,
            ValueError,
            LookupError,
            TypeError,
            ArithmeticError,
            NotImplementedError,
            MemoryError,
        ) as error:  # and Arrow's own
            pass_on_shortage(error, path)
            raise DataError(
                f"Reading {key} from {path}: {shortened(str(error))}; convert the recordings again."
            ) from error
        return values


@lru_cache(maxsize=64)
def _metadata(path: Path, version: Version) -> Any:
    """Return what a file says of all its row groups, which are asked for one by one."""
    from pyarrow import parquet

    return parquet.read_metadata(path)


def _read_group(path: Path, version: Version, group: int, samples: int, columns: list[str]) -> Any:
    """Read one row group after its length and the types of its columns, pages against their checksums."""
    from pyarrow import parquet

    about = _metadata(path, version)
    with parquet.ParquetFile(
        path, metadata=about, memory_map=True, pre_buffer=False, page_checksum_verification=True
    ) as file:
        found = file.metadata.row_group(group).num_rows
        if found != samples:
            raise DataError(
                f"Reading {path}: {samples} samples are expected in row group {group}, found {found}; convert the recordings again."
            )
        if samples > limits.MAX_SAMPLES:
            raise DataError(
                f"Reading {path}: an episode has {samples} samples; cut it, or raise MAX_SAMPLES in kros.core.limits."
            )
        schema = file.schema_arrow
        for name in columns:
            kind = str(schema.field(name).type)
            if (name in KEYS and "string" not in kind) or (name not in KEYS and kind != "double"):
                wanted = "text" if name in KEYS else "numbers of type double"
                raise DataError(
                    f"Reading {path}: column {name!r} should hold {wanted}, found {kind}; convert the recordings again."
                )
        return file.read_row_group(group, columns=columns, use_threads=False)


def _check_label(column: Any, name: str, expected: str, path: Path) -> None:
    """Refuse samples that say they belong to something else than the index says."""
    found = column.unique().to_pylist()
    if found != [expected]:
        raise DataError(
            f"Reading {path}: the index says {name} {expected!r}, the samples say {shortened(repr(found))}; files were renamed or exchanged, convert "
            "the recordings again."
        )


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
    >>> population = kros.from_arrays({"a": [np.eye(5, 2)]}, states=["x"], measured=["x"], inputs=["u"], sample_period_s=0.01)
    >>> with TemporaryDirectory() as folder:
    ...     kros.data.write_parquet(population, f"{folder}/recordings")
    ...     print(kros.data.read_parquet(f"{folder}/recordings"))
    Population(1 unit, 1 condition, 1 episode every 0.01 s; states x (measured); inputs u)
    """
    content, _ = load_artifact(Path(folder), INDEX)
    try:
        channels = tuple(
            Channel(c["name"], Role(c["role"]), _text(c["unit"]), c["measured"] is True) for c in content["channels"]
        )
        channels += tuple(
            TrueChannel(t["name"], Role.TRUTH, _text(t["unit"]), of=_text(t["of"])) for t in content.get("truths", ())
        )
        channels = columns_in_order(channels)
        units = [Unit(_text(u["id"]), _text(u["group"]), dict(u["metadata"])) for u in content["units"]]
        places = _places(content["groups"])
        period = check_period(content["sample_period_s"], f"Reading {Path(folder) / 'population.json'}")
        metadata = dict(content["metadata"])
        scaling = {name: build(Scaling, own, f"scaling.{name}") for name, own in content.get("scaling", {}).items()}
    except DataError:
        raise
    except (LookupError, TypeError, ValueError, AttributeError) as error:
        raise DataError(
            f"Reading {Path(folder) / 'population.json'}: not as kros writes it ({error!r}); convert the recordings again."
        ) from error
    missing = sorted({name for name, _, _ in places.values() if not (Path(folder) / name).is_file()})
    if missing:
        raise DataError(
            f"Reading {folder}: {len(missing)} files are missing, the first {missing[0]}; convert the recordings again."
        )
    recordings = ParquetRecordings(places, str(folder), tuple(c.name for c in channels))
    return assemble(recordings, channels, units, period, metadata, scaling=scaling)


def _places(groups: Iterable[Mapping[str, Any]]) -> dict[EpisodeKey, tuple[str, int, int]]:
    places: dict[EpisodeKey, tuple[str, int, int]] = {}
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
