"""Recordings in the files of measurement programs, each as tables of columns that share their samples.

A format is a function that yields signals by name, nested as in the file, and their units of measure.
"""

import gc
import sys
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from functools import cache, lru_cache
from pathlib import Path
from typing import Any

import numpy as np

from ...core import Array, ByName, DataError, MissingDependencyError, Record, limits
from ...core.arrays import Texts
from ...core.files import pass_on_shortage, require_regular, shortened, stamp_of
from ..recording import some

Group = tuple[ByName, Mapping[str, str]]


def _matlab(path: Path) -> Iterator[Group]:
    """MATLAB, of version 7.3 through HDF5."""
    from scipy.io import loadmat

    try:
        yield loadmat(path, simplify_cells=True), {}
    except NotImplementedError:
        yield from _hdf5(path)


def _hdf5(path: Path) -> Iterator[Group]:
    """HDF5; a unit of measure is the attribute `units` or `unit` of a data set."""
    import h5py

    content, units = {}, {}

    def visit(place: str, item: Any) -> None:
        name, unit = place.replace("/", "."), item.attrs.get("units", item.attrs.get("unit", ""))
        if isinstance(item, h5py.Dataset) and item.attrs.get("MATLAB_class") != b"char":
            content[name], units[name] = item[()], unit.decode() if isinstance(unit, bytes) else str(unit)

    with h5py.File(path) as file:
        file.visititems(visit)
    yield content, units


def _mdf(path: Path) -> Iterator[Group]:
    """MDF, versions 3 and 4: every group has a time base."""
    from asammdf import MDF

    with path.open("rb") as file, MDF(file) as recording:
        groups: list[Any] = recording.groups
        for i, group in enumerate(groups):
            signals = [recording.get(group=i, index=j) for j in range(len(group.channels))]
            values = {s.name: s.samples for s in signals}
            for s in signals:
                if s.invalidation_bits is not None:
                    values[s.name] = np.where(s.invalidation_bits, np.nan, s.samples)
            yield values, {s.name: s.unit for s in signals}


def _tdms(path: Path) -> Iterator[Group]:
    """TDMS: the time of a group follows from the increment of its waveforms."""
    from nptdms import TdmsFile

    for group in TdmsFile.read(path).groups():
        signals = group.channels()
        waveform = next((c for c in signals if "wf_increment" in c.properties), None)
        time = {} if waveform is None else {"time": waveform.properties["wf_increment"] * np.arange(len(waveform))}
        units = {c.name: str(c.properties.get("unit_string", "")) for c in signals}
        yield time | {c.name: c[:] for c in signals}, {"time": "s"} | units


def _bag(path: Path) -> Iterator[Group]:
    """ROS bags and MCAP: a group for every topic, with the time since the first message."""
    from rosbags.highlevel import AnyReader
    from rosbags.typesys import Stores, get_typestore

    rows = dict[str, list[Record]]()
    with AnyReader([path], default_typestore=get_typestore(Stores.LATEST)) as reader:
        for connection, stamp, raw in reader.messages():
            numbers = {"time": 1e-9 * (stamp - reader.start_time)}
            for name, value in _signals(connection.topic, reader.deserialize(raw, connection.msgtype)):
                if value.dtype != np.uint8:  # bytes of pictures
                    numbers |= {f"{name}.{i}" if value.ndim else name: v for i, v in enumerate(value.flat, 1)}
            rows.setdefault(connection.topic, []).append(numbers)
    for messages in rows.values():
        names = [name for name in messages[0] if all(name in m for m in messages)]
        yield {name: np.array([m[name] for m in messages]) for name in names}, {"time": "s"}


def _arrow(path: Path) -> Iterator[Group]:
    """Parquet and Feather, as pandas writes them; a unit of measure is the field's metadatum `unit`."""
    from pyarrow import feather, parquet

    table = (parquet if path.suffix.lower() == ".parquet" else feather).read_table(path)
    table = table.rename_columns([name.replace("__index_level_0__", "index") for name in table.column_names])
    units = {field.name: (field.metadata or {}).get(b"unit", b"").decode() for field in table.schema}
    signals = {name: table[name].to_numpy() for name in table.column_names}
    yield {name: s.astype(str) if s.dtype == object else s for name, s in signals.items()}, units


# by the end of a file's name, with the extra that installs what it needs
FORMATS: dict[str, tuple[Callable[[Path], Iterator[Group]], str]] = {
    ".mat": (_matlab, "mat73"),
    **dict.fromkeys((".parquet", ".feather"), (_arrow, "")),
    ".tdms": (_tdms, "tdms"),
    **dict.fromkeys((".h5", ".hdf5", ".hdf"), (_hdf5, "hdf5")),
    **dict.fromkeys((".mf4", ".mdf"), (_mdf, "mdf")),
    **dict.fromkeys((".bag", ".mcap", ".db3"), (_bag, "rosbags")),
}


def is_binary(path: Path) -> bool:
    """Tell whether a file is read by a package rather than as text."""
    return path.suffix.lower() in FORMATS


def columns_of(path: Path, wanted: Collection[str | int | None] = ()) -> Texts:
    """Return the columns of the table of a file that `wanted` names, with their units of measure."""
    tables = _heads(path, stamp_of(path))
    return tables[_chosen(path, tables, wanted)]


def signals_of(path: Path, names: Sequence[str]) -> list[Array]:
    """Return columns of one table of a file, as they are."""
    version = stamp_of(path)
    table = _tables(path, version)[_chosen(path, _heads(path, version), names)]
    return [table[name][0] for name in names]


def values_of(path: Path, names: Sequence[str]) -> Array:
    """Return columns of one table of a file, shape (n_samples, len(names))."""
    try:
        return np.column_stack([signal.astype(float) for signal in signals_of(path, names)])
    except ValueError as error:  # a column of text
        raise DataError(f"Reading {path}: {error}; declare columns of numbers.") from error


def texts_of(path: Path, name: str) -> list[str]:
    """Return a column of a file as text."""
    (values,) = signals_of(path, [name])
    return [str(value).strip() if values.dtype.kind == "U" else f"{value:g}" for value in values]


def _chosen(path: Path, tables: Sequence[Mapping[str, str]], wanted: Collection[str | int | None]) -> int:
    """Return which table of a file holds the most of the wanted columns, of equals the first."""
    names = [name for name in wanted if isinstance(name, str)]
    chosen = max(range(len(tables)), key=lambda i: len(tables[i].keys() & names))
    there, known = tables[chosen], {name for table in tables for name in table}
    if elsewhere := [name for name in names if name in known and name not in there]:
        problem = f"{some([n for n in names if n in there])} and {some(elsewhere)} have different time bases"
        raise DataError(f"Reading {path}: {problem}; bring them to one rate first, or declare channels of one of them.")
    return chosen


@cache
def _heads(path: Path, version: tuple[int, int]) -> list[Texts]:
    """Return the columns of all tables of a file with their units, kept since reading some formats takes long."""
    return [{name: unit for name, (_, unit) in table.items()} for table in _tables(path, version)]


@lru_cache(maxsize=1)
def _tables(path: Path, version: tuple[int, int]) -> list[dict[str, tuple[Array, str]]]:
    """Return the tables of a file, columns of equal length with their units, those with most numbers first."""
    require_regular(path, limits.MAX_ARRAYS_BYTES)
    read, extra = FORMATS[path.suffix.lower()]
    tables, problem = list[dict[str, tuple[Array, str]]](), "it holds no signals"
    hook, sys.unraisablehook = sys.unraisablehook, lambda _: None  # asammdf fails to delete what it could not open
    try:
        for content, units in read(path):
            by_length = dict[int, dict[str, tuple[Array, str]]]()
            for name, signal in _signals("", content):
                if signal.size > 1:
                    values = signal if signal.dtype.kind == "U" else signal.astype(float)
                    by_length.setdefault(len(signal), {})[name] = values, units.get(name, "")
            tables += by_length.values()
    except ImportError as error:
        raise MissingDependencyError(f"Reading {path}: {error}; pip install 'kros[{extra}]'.") from error
    except Exception as error:  # what these packages raise on damaged files has no common base
        pass_on_shortage(error, path)
        tables, problem = [], f"{type(error).__name__}, {shortened(str(error))}"
    finally:
        if not tables:
            gc.collect()
        sys.unraisablehook = hook
    if not tables:
        raise DataError(f"Reading {path}: {problem}; restore the file, or leave it out with exclude.")
    return sorted(tables, key=lambda table: -sum(len(values) for values, _ in table.values()))


def _signals(name: str, value: Any) -> Iterator[tuple[str, Any]]:
    """Yield the arrays of numbers inside mappings, lists, records and messages, with the path of their names."""
    value = vars(value) if hasattr(value, "__msgtype__") else value
    array: Any = np.empty(0) if isinstance(value, Mapping | list) else np.asarray(value)
    if fields := array.dtype.names:
        value = {key: array[key] for key in fields}
    elif isinstance(value, list) or (array.dtype == object and array.ndim):
        value = dict(enumerate(value, 1))
    if isinstance(value, Mapping):
        for key, inside in value.items():
            if not str(key).startswith(("#", "__")):  # what libraries add
                yield from _signals(f"{name}.{key}" if name else str(key), inside)
    elif array.dtype.kind == "M" and array.size:
        yield name, (array - array.flat[0]) / np.timedelta64(1, "s")
    elif array.dtype.kind in "biuf" and array.ndim == 2:
        rows = array if len(array) < array.shape[1] else array.T  # a row a signal
        yield from ((f"{name}.{i}" if len(rows) > 1 else name, row) for i, row in enumerate(rows, 1))
    elif array.dtype.kind in "biufU" and array.ndim < 2:
        yield name, array
