"""Write a population in kros's native format.

    <out>/population.json                    channels, period, units, episodes with their lengths
    <out>/<unit>@<condition>.parquet         one row group an episode: unit, condition, episode, k, then the channels
    and truths

Names of files are percent-encoded, so any id works. A study writes groups from several processes (`write_group`),
then the index.
"""

from __future__ import annotations

import logging
import os
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import partial
from hashlib import sha256
from pathlib import Path
from typing import Any
from urllib.parse import quote

import numpy as np
import numpy.typing as npt

from ...core.artifacts import save_artifact
from ...core.errors import DataError
from ..arrow import from_numpy, repeated
from ..checks import Look, check_structure, refuse_copies, usable_episodes
from ..population import EpisodeKey, Population
from ..readers.parquet import INDEX, KEYS
from .folders import in_threads, whole_folder

logger = logging.getLogger(__name__)

_INDEXED = ("unit", "condition", "file", "episodes", "samples")
LONGEST_NAME = 200  # file systems allow 255 bytes, and a temporary name is longer
# Signals as bytes of equal weight side by side, then LZ4: 57 % of the size for 0.03 s per 91 MB; zstd: 55 %, 0.08 s.
COMPRESSION, SIGNALS, COUNTER = "lz4", "BYTE_STREAM_SPLIT", "DELTA_BINARY_PACKED"


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


def group_file(unit: str, condition: str) -> str:
    """Return the name of the file of one unit and condition; different ids never share a name."""
    name = f"{quote(unit, safe='')}@{quote(condition, safe='')}"
    if len(name) > LONGEST_NAME:
        name = f"{name[: LONGEST_NAME - 65]}~{sha256(name.encode()).hexdigest()}"
    return f"{name}.parquet"


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


def write_index(
    population: Population, records: Iterable[GroupRecord], folder: Path | str, converted: bool = True
) -> None:
    """Write `population.json` for groups that were written; where they are `converted`, they are new recordings."""
    groups = [g for g in records if g.episodes]
    written = {g.unit for g in groups}
    check_structure(population.columns, [EpisodeKey(g.unit, g.condition, e) for g in groups for e in g.episodes])
    refuse_copies(pair for g in groups for pair in g.recognised)
    scaling = {
        name: replace(scale, converted=scale.factor) if converted else scale
        for name, scale in population.scaling.items()
    }
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
    groups = [(unit, condition) for unit, condition, _ in population.groups()]
    with whole_folder(Path(out)) as folder:
        records = in_threads([partial(write_group, population, *group, folder) for group in groups])
        write_index(population, records, folder, converted)


def _write_episodes(
    population: Population, keys: Sequence[EpisodeKey], path: Path, on_nan: str, look: Look | None
) -> Iterator[tuple[str, int, str]]:
    """Write usable episodes one behind the other; yield episode, number of samples and digest."""
    from pyarrow import parquet

    names = [c.name for c in population.columns]
    schema = _schema(names)
    options: dict[str, Any] = {
        "column_encoding": {"k": COUNTER, **dict.fromkeys(names, SIGNALS)},
        "compression": COMPRESSION,
        "use_dictionary": list(KEYS),
        "write_statistics": False,
        "write_page_checksum": True,
    }
    with parquet.ParquetWriter(path, schema, **options) as writer:
        for key, values, digest in usable_episodes(population, keys, on_nan, look):
            writer.write_table(_table(key, values, schema), row_group_size=len(values))
            yield key.episode, len(values), digest


def _schema(names: Sequence[str]) -> Any:
    """Return unit, condition, episode, k, then the channels."""
    import pyarrow as pa

    clash = sorted({*KEYS, "k"} & set(names))
    if clash:
        problem = f"channels {clash} have the name of a key column ({', '.join(KEYS)}, k)"
        raise DataError(f"Writing Parquet: {problem}; rename them.")
    text = pa.dictionary(pa.int32(), pa.string())
    return pa.schema([*((name, text) for name in KEYS), ("k", pa.int64()), *((name, pa.float64()) for name in names)])


def _table(key: EpisodeKey, values: npt.NDArray[np.float64], schema: Any) -> Any:
    """Return an episode as an Arrow table."""
    import pyarrow as pa

    keys = [repeated(text, len(values)) for text in (key.unit, key.condition, key.episode)]
    columns = [from_numpy(column) for column in np.ascontiguousarray(values.T)]
    return pa.Table.from_arrays([*keys, from_numpy(np.arange(len(values), dtype=np.int64)), *columns], schema=schema)
