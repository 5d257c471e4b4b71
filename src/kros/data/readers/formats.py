"""Recordings in the files of measurement programs, each as tables of columns that share their samples.

A format is a function from a path to its tables, in `FORMATS` under the ends of names. The packages that read them are
optional. Text is not here: it is read in blocks, by `tables`.
"""

from __future__ import annotations

import gc
import sys
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from functools import cache, lru_cache
from importlib import import_module
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from ...core import limits
from ...core.errors import DataError, MissingDependencyError
from ...core.files import pass_on_shortage, require_regular, shortened, stamp_of
from ..recording import some

Array = npt.NDArray[np.float64]


@dataclass(frozen=True)
class Table:
    """Columns of a file with as many samples each, and what it says of their units of measure."""

    columns: dict[str, Array]
    units: dict[str, str] = field(default_factory=dict)


def _package(name: str, extra: str, path: Path) -> Any:
    """Import a package that an extra installs."""
    try:
        return import_module(name)
    except ImportError as error:
        needs = f"Reading {path} needs the package {name.partition('.')[0]}"
        raise MissingDependencyError(f"{needs}: pip install 'kros[{extra}]'.") from error


def _signals(name: str, value: Any) -> Iterator[tuple[str, Any]]:
    """Yield the numbers inside mappings, lists, records and arrays with the path of their names."""
    value = vars(value) if hasattr(value, "__msgtype__") else value
    array = np.empty(0) if isinstance(value, Mapping | list) else np.asarray(value)
    if array.dtype.names:
        value = {key: array[key] for key in array.dtype.names}
    elif isinstance(value, list) or (array.dtype == object and array.ndim):
        value = dict(enumerate(value, 1))
    if isinstance(value, Mapping):
        for key, inside in value.items():
            yield from _signals(f"{name}.{key}" if name else str(key), inside)
    elif array.dtype.kind == "M":
        yield name, (array - array.ravel()[0]) / np.timedelta64(1, "s") if array.size else np.zeros(0)
    elif array.dtype.kind in "biuf" and array.ndim < 3:
        array = array.T if array.ndim == 2 and array.shape[0] < array.shape[1] else array  # rows are samples
        columns = array.reshape(len(array), -1).T if array.ndim == 2 else [array]
        yield from ((name if len(columns) == 1 else f"{name}.{i}", c) for i, c in enumerate(columns, 1))


def _tables(signals: Iterable[tuple[str, Any]], units: Mapping[str, str] | None = None) -> Iterator[Table]:
    """Yield tables of the signals that have equally many samples."""
    by_length: dict[int, dict[str, Array]] = {}
    for name, values in signals:
        if np.size(values) > 1:
            by_length.setdefault(len(values), {})[name] = np.asarray(values, dtype=float)
    yield from (Table(columns, dict(units or {})) for columns in by_length.values())


def _matlab(path: Path) -> Iterator[Table]:
    """MATLAB, of version 7.3 through HDF5."""
    from scipy.io import loadmat

    try:
        content = loadmat(path, simplify_cells=True)
    except NotImplementedError:
        yield from _hdf5(path, "mat73")
        return
    yield from _tables(_signals("", {name: value for name, value in content.items() if name[:2] != "__"}))


def _hdf5(path: Path, extra: str = "hdf5") -> Iterator[Table]:
    """HDF5; a unit of measure is the attribute `units` or `unit` of a data set."""
    h5py, content, units = _package("h5py", extra, path), dict[str, Any](), dict[str, str]()

    def visit(name: str, item: Any) -> None:
        about = item.attrs
        if isinstance(item, h5py.Dataset) and not name.startswith("#") and about.get("MATLAB_class") != b"char":
            content[name.replace("/", ".")] = item[()]
            unit = about.get("units", about.get("unit", ""))
            units[name.replace("/", ".")] = unit.decode() if isinstance(unit, bytes) else str(unit)

    with h5py.File(path) as file:
        file.visititems(visit)
    yield from _tables(_signals("", content), units)


def _mdf(path: Path) -> Iterator[Table]:
    """MDF, versions 3 and 4: every group has a time base."""
    asammdf = _package("asammdf", "mdf", path)
    with path.open("rb") as file, asammdf.MDF(file) as recording:
        for i, group in enumerate(recording.groups):
            signals = [recording.get(group=i, index=j) for j in range(len(group.channels))]
            values = {s.name: s.samples for s in signals}
            values |= {
                s.name: np.where(s.invalidation_bits, np.nan, s.samples)
                for s in signals
                if s.invalidation_bits is not None
            }
            yield from _tables(_signals("", values), {s.name: s.unit for s in signals})


def _tdms(path: Path) -> Iterator[Table]:
    """TDMS: the time of a group follows from the increment of its waveforms."""
    for group in _package("nptdms", "tdms", path).TdmsFile.read(path).groups():
        about = {c.name: c.properties for c in group.channels()}
        units = {name: str(p.get("unit_string", "")) for name, p in about.items()}
        signals = list(_signals("", {c.name: c[:] for c in group.channels()}))
        steps = {len(v): about[name]["wf_increment"] for name, v in signals if "wf_increment" in about[name]}
        times = [("time", step * np.arange(n)) for n, step in steps.items()]
        yield from _tables([*times, *signals], {"time": "s", **units})


def _bag(path: Path) -> Iterator[Table]:
    """ROS bags and MCAP: a table for every topic, with the time since the first message, s."""
    package, types = _package("rosbags.highlevel", "rosbags", path), _package("rosbags.typesys", "rosbags", path)
    rows: dict[str, list[dict[str, Any]]] = {}
    default = types.get_typestore(types.Stores.LATEST)
    with package.AnyReader([path], default_typestore=default) as reader:
        for connection, stamp, raw in reader.messages():
            message = reader.deserialize(raw, connection.msgtype)
            signals = {"time": 1e-9 * (stamp - reader.start_time)}
            for name, value in _signals(connection.topic, message):
                places = enumerate(np.ravel(value), 1) if value.dtype != np.uint8 else ()  # bytes of pictures
                signals |= {name if value.ndim == 0 else f"{name}.{i}": number for i, number in places}
            rows.setdefault(connection.topic, []).append(signals)
    for messages in rows.values():
        names = [name for name in messages[0] if all(name in m for m in messages)]
        yield from _tables(((name, [m[name] for m in messages]) for name in names), {"time": "s"})


FORMATS: dict[str, Callable[[Path], Iterator[Table]]] = {
    **dict.fromkeys((".h5", ".hdf5", ".hdf"), _hdf5),
    **dict.fromkeys((".mf4", ".mdf"), _mdf),
    **dict.fromkeys((".bag", ".mcap", ".db3"), _bag),
    ".mat": _matlab,
    ".tdms": _tdms,
}


def is_binary(path: Path) -> bool:
    """Tell whether a file is read by a package rather than as text."""
    return path.suffix.lower() in FORMATS


def columns_of(path: Path, wanted: Collection[str | int | None] = ()) -> dict[str, str]:
    """Return the columns of the table of a file that `wanted` names, with their units of measure."""
    tables = _heads(path, stamp_of(path))
    return tables[_chosen(path, tables, wanted)]


def values_of(path: Path, names: Sequence[str]) -> Array:
    """Return columns of one table of a file, shape (n_samples, len(names))."""
    version = stamp_of(path)
    columns = _loaded(path, version)[_chosen(path, _heads(path, version), names)].columns
    return np.column_stack([columns[name] for name in names])


def _chosen(path: Path, tables: Sequence[Mapping[str, str]], wanted: Collection[str | int | None]) -> int:
    """Return which table of a file holds the most of the wanted columns, of several the one with most columns."""
    names = [name for name in wanted if isinstance(name, str)]
    chosen = max(range(len(tables)), key=lambda i: (len(tables[i].keys() & names), len(tables[i])))
    known, others = tables[chosen].keys(), {name for table in tables for name in table}
    if elsewhere := [name for name in names if name in others and name not in known]:
        problem = f"{some([n for n in names if n in known])} and {some(elsewhere)} have different time bases"
        raise DataError(f"Reading {path}: {problem}; bring them to one rate first, or declare channels of one of them.")
    return chosen


@cache
def _heads(path: Path, version: tuple[int, int]) -> list[dict[str, str]]:
    """Return the columns of all tables of a file, with their units; kept, since reading some formats takes long."""
    return [{name: table.units.get(name, "") for name in table.columns} for table in _loaded(path, version)]


@lru_cache(maxsize=1)
def _loaded(path: Path, version: tuple[int, int]) -> list[Table]:
    """Return all tables of a file."""
    require_regular(path, limits.MAX_ARRAYS_BYTES)
    problem = "it holds no signals"
    with _deleted_quietly():
        try:
            if tables := list(FORMATS[path.suffix.lower()](path)):
                return tables
        except MissingDependencyError:
            raise
        except Exception as error:  # what these packages raise on damaged files has no common base
            pass_on_shortage(error, path)
            problem = f"{type(error).__name__}, {shortened(str(error))}"
        gc.collect()
    raise DataError(f"Reading {path}: {problem}; restore the file, or leave it out with exclude.")


@contextmanager
def _deleted_quietly() -> Iterator[None]:
    """Hide errors while objects are deleted: asammdf fails to delete what it could not open."""
    hook, sys.unraisablehook = sys.unraisablehook, lambda _: None
    try:
        yield
    finally:
        sys.unraisablehook = hook
