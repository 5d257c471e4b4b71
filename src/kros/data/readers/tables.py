"""Numbers from one table, text or Parquet, fast, in bounded memory, with errors that name the file and the column."""

from __future__ import annotations

import codecs
import csv
import gzip
import re
import sys
import zlib
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from itertools import chain
from pathlib import Path
from typing import IO, Any

import numpy as np
import numpy.typing as npt

from ...core import limits
from ...core.errors import DataError
from ...core.files import pass_on_shortage, require_regular, shortened

Array = npt.NDArray[np.float64]
# cells of spreadsheets without a number
ABSENT = ("-", "--", "---", *["#DIV/0!", "#NUM!", "#REF!", "#VALUE!", "#WERT!", "#ZAHL!", "#BEZUG!", "#NV"])
BLOCK = 1 << 22  # bytes that Arrow parses at once; a line has to fit into two
PARQUET = ".parquet"
CLOCK = r"(?P<hour>\d{1,2}):(?P<minute>\d{2}):(?P<second>\d{2})(?:[.,:](?P<fraction>\d{1,9}))?(?:Z|[+-]\d{2}:?\d{2})?"
_DATE_PARTS = {"y": r"(?P<year>\d{4})", "m": r"(?P<month>\d{1,2})", "d": r"(?P<day>\d{1,2})"}
DATES = {order: "[-./]".join(_DATE_PARTS[letter] for letter in order) for order in ("ymd", "dmy", "mdy")}


@dataclass(frozen=True)
class Dialect:
    """How a text file is written: delimiter, whether a line names the columns, lines before it, decimal point, ..."""

    delimiter: str = ","
    header: bool = True
    skip_rows: int = 0
    decimal: str = "."
    encoding: str = "utf-8"
    unit_rows: int = 0  # lines between the header and the numbers


COMMA = Dialect()


def file_fields(path: Path, dialect: Dialect = COMMA) -> list[str]:
    """Return the names of a table's columns, or the first numbers where it has no header."""
    if path.suffix != PARQUET:
        return _text_fields(path, dialect)
    from pyarrow import parquet

    require_regular(path, sys.maxsize)
    try:
        return list(parquet.read_schema(path).names)
    except (OSError, ValueError) as error:
        problem = f"no Parquet file that can be read ({shortened(str(error))})"
        raise DataError(f"Reading {path}: {problem}; check the file.") from error


def read_columns(
    path: Path, names: Sequence[str], wanted: Sequence[str], dialect: Dialect = COMMA, timestamp: str | None = None
) -> Array:
    """Read some columns of a table by names that are given to all of them, shape (len(wanted), n_rows).

    With the order of a date in `timestamp` the first one holds timestamps, which become seconds.
    """
    import pyarrow as pa

    with _explained(path, names):
        if path.suffix == PARQUET:
            table = _parquet_table(path, names, wanted, timestamp)
        else:
            table = pa.Table.from_batches(list(_text_batches(path, names, wanted, dialect, timestamp)))
        columns = [table.column(name) for name in wanted]
        first = [] if timestamp is None else [seconds_of(columns.pop(0), timestamp)]
        return np.array([*first, *map(to_numpy, columns)]).reshape(len(wanted), table.num_rows)


def read_blocks(
    path: Path, names: Sequence[str], wanted: Sequence[str], dialect: Dialect, rows: int
) -> Iterator[Array]:
    """Yield some columns of a text file in blocks of at least `rows`, the last one apart, shape (n, len(wanted))."""
    import pyarrow as pa

    batches: list[Any] = []
    with _explained(path, names):
        for batch in chain(_text_batches(path, names, wanted, dialect, None), [None]):
            if batches and (batch is None or sum(b.num_rows for b in batches) >= rows):
                table, batches = pa.Table.from_batches(batches), []
                yield np.column_stack([to_numpy(table.column(name)) for name in wanted])
            batches.append(batch)


@contextmanager
def _explained(path: Path, names: Sequence[str]) -> Iterator[None]:
    """Turn what Arrow says about a file into one error."""
    import pyarrow as pa

    try:
        yield
    except DataError:
        raise
    except (pa.ArrowException, OSError, ValueError, LookupError, MemoryError) as error:
        pass_on_shortage(error, path)
        raise DataError(f"Reading {path}: {_explain(str(error), names)}; correct the file, or the mapping.") from error


def _text_batches(
    path: Path, names: Sequence[str], wanted: Sequence[str], dialect: Dialect, timestamp: str | None
) -> Iterator[Any]:
    """Yield batches of columns of a text file as numbers, but for the first one with `timestamp`."""
    import pyarrow as pa
    from pyarrow import csv as arrow

    kinds = dict.fromkeys(wanted, pa.float64()) | ({} if timestamp is None else {wanted[0]: pa.string()})
    options = (
        arrow.ReadOptions(use_threads=False, column_names=list(names), block_size=BLOCK),
        arrow.ParseOptions(delimiter=dialect.delimiter),
        arrow.ConvertOptions(
            column_types=kinds,
            include_columns=list(kinds),
            decimal_point=dialect.decimal,
            null_values=[*arrow.ConvertOptions().null_values, *ABSENT],
        ),
    )
    with opened(path, dialect.encoding) as file:
        lines = dialect.skip_rows + dialect.header + (dialect.unit_rows if dialect.header else 0)
        _skip(file, lines, path)  # here, so that both readings count lines alike
        try:
            yield from arrow.open_csv(pa.PythonFile(file, mode="r"), *options)
        except pa.ArrowInvalid as error:
            if "Empty CSV" not in str(error):
                raise
            yield from pa.schema(kinds).empty_table().to_batches() or [pa.RecordBatch.from_pylist([], pa.schema(kinds))]


def _parquet_table(path: Path, names: Sequence[str], wanted: Sequence[str], timestamp: str | None) -> Any:
    """Read columns of a Parquet file as numbers, but for the first one with `timestamp`."""
    import pyarrow as pa
    from pyarrow import parquet

    require_regular(path, sys.maxsize)
    file = parquet.ParquetFile(path)
    if file.metadata.num_rows > limits.MAX_SAMPLES:
        advice = "cut it, or raise MAX_SAMPLES in kros.core.limits"
        raise DataError(f"Reading {path}: has more than {limits.MAX_SAMPLES} rows; {advice}.")
    fields = [file.schema_arrow.names[list(names).index(name)] for name in wanted]
    kinds = dict.fromkeys(wanted, pa.float64()) | ({} if timestamp is None else {wanted[0]: pa.timestamp("ns")})
    table = file.read(columns=fields, use_threads=False).select(fields)
    return table.rename_columns(list(wanted)).cast(pa.schema(kinds))


def parquet_head(path: Path, rows: int) -> tuple[list[str], list[tuple[str, ...]]]:
    """Return the names of a Parquet file's columns, and its first rows as text."""
    from pyarrow import parquet

    fields = file_fields(path)
    batch = next(parquet.ParquetFile(path).iter_batches(batch_size=rows), None)
    if batch is None:
        return fields, []
    columns = [["" if value is None else str(value) for value in c.to_pylist()] for c in batch.columns]
    return fields, list(zip(*columns, strict=True))


class LimitedFile:
    """An open file that gives no more than is ever read; text that was packed too tightly is refused."""

    def __init__(self, file: IO[bytes], path: Path) -> None:
        self._file, self._path = file, path
        self._given, self.closed = 0, False

    def read(self, size: int = -1) -> bytes:
        """Return the next bytes."""
        return self._counted(self._file.read(BLOCK if size is None or size < 0 else size))

    def readline(self) -> bytes:
        """Return the next line with its end, or refuse one that is longer than any header."""
        line = self._counted(self._file.readline(limits.MAX_LINE_BYTES + 1))
        if len(line) > limits.MAX_LINE_BYTES:
            problem = f"a line at the start is longer than {limits.MAX_LINE_BYTES} bytes, so this is no table of text"
            raise DataError(f"Reading {self._path}: {problem}; check the file and its line ends.")
        if b"\r" in line.removesuffix(b"\r\n").removesuffix(b"\r"):
            problem = "lines end with CR alone, as on old systems"
            raise DataError(f"Reading {self._path}: {problem}; convert the line ends to LF or CR LF.")
        if b"\0" in line:
            problem = "holds NUL bytes, so it is binary or UTF-16"
            raise DataError(f"Reading {self._path}: {problem}; convert it to text in UTF-8.")
        return line

    def close(self) -> None:
        """Mark the file as read."""
        self.closed = True

    def _counted(self, content: bytes) -> bytes:
        self._given += len(content)
        if self._given > limits.MAX_TEXT_BYTES:
            advice = "split it, or raise MAX_TEXT_BYTES in kros.core.limits"
            raise DataError(f"Reading {self._path}: unpacks to more than {limits.MAX_TEXT_BYTES} bytes; {advice}.")
        return content


@contextmanager
def opened(path: Path, encoding: str = "utf-8") -> Iterator[LimitedFile]:
    """Open a regular text file, unpacked where it ends in ``.gz``; what has two bytes a character is given in UTF-8."""
    require_regular(path, limits.MAX_TEXT_BYTES)
    opener: Any = gzip.open if path.suffix == ".gz" else open
    try:
        with opener(path, "rb") as file:
            yield LimitedFile(file if _has_ascii(encoding) else codecs.EncodedFile(file, "utf-8", encoding), path)
    except (OSError, EOFError, zlib.error, UnicodeError) as error:
        raise DataError(f"Reading {path}: cannot be read ({error}); check the file, or restore it.") from error


def _has_ascii(encoding: str) -> bool:
    """Tell whether digits and marks are the bytes that they are in ASCII."""
    return "0;".encode(encoding) == b"0;"


def _text_fields(path: Path, dialect: Dialect) -> list[str]:
    """Return the fields of the header, or of the first line of numbers, without surrounding space and quotes."""
    with opened(path, dialect.encoding) as file:
        _skip(file, dialect.skip_rows, path)
        line = _text(file.readline(), path, dialect.encoding)
        if not line.strip():
            raise DataError(f"Reading {path}: the file is empty or starts with an empty line; remove it or restore it.")
        fields = _fields(line, path, dialect)
        if dialect.header:
            _skip(file, dialect.unit_rows, path)
            row = _fields(_text(file.readline(), path, dialect.encoding), path, dialect)
            if len(row) > len(fields) and not any(row[len(fields) :]):
                fields += row[len(fields) :]
            elif len(fields) > len(row) > 1 and not any(fields[len(row) :]):
                fields = fields[: len(row)]
    return fields


def _fields(line: str, path: Path, dialect: Dialect) -> list[str]:
    try:
        row = next(csv.reader([line], delimiter=dialect.delimiter, skipinitialspace=True), [])
    except csv.Error as error:
        raise DataError(f"Reading {path}: its first line is no list of columns ({error}); correct the file.") from error
    return [part.strip() for part in row]


def _skip(file: LimitedFile, lines: int, path: Path) -> None:
    for line in range(lines):
        if not file.readline():
            actual = f"{lines} lines stand before the numbers by the mapping, found {line} in all"
            raise DataError(f"Reading {path}: {actual}; correct skip_rows.")


def _text(line: bytes, path: Path, encoding: str) -> str:
    named = encoding if _has_ascii(encoding) else "utf-8"
    named = "utf-8-sig" if codecs.lookup(named).name == "utf-8" else named
    try:
        return line.decode(named).rstrip("\r\n").removeprefix("\ufeff")
    except UnicodeDecodeError as error:
        problem = f"its first line is not {encoding.upper()} ({error})"
        raise DataError(f"Reading {path}: {problem}; name the encoding, such as cp1252.") from error


def _explain(message: str, names: Sequence[str]) -> str:
    """Return Arrow's message, with the number of a column (from zero, in the file) replaced by its name."""
    if "straddling" in message:
        return f"a line, or a text in quotes, is longer than {BLOCK} bytes"
    return shortened(re.sub(r"In CSV column #(\d+):", lambda match: f"in column {names[int(match[1])]!r}:", message))


def timestamp_pattern(order: str) -> str:
    """Return the expression of timestamps with a date in some order, ``ymd``, ``dmy`` or ``mdy``, or without a date."""
    return rf"^\s*(?:{DATES[order]}[T ]\s*)?{CLOCK}\s*$"


def seconds_of(column: Any, order: str) -> Array:
    """Return timestamps, perhaps as text, as seconds since the first one, NaN where there is none, shape (n_rows,)."""
    import pyarrow as pa
    import pyarrow.compute as pc

    if pa.types.is_timestamp(column.type):
        count = column.cast(pa.int64())
        return 1e-9 * to_numpy(pc.subtract(count, pc.min(count)).cast(pa.float64()))
    parts = pc.extract_regex(column.combine_chunks(), pattern=timestamp_pattern(order))
    bad = parts.is_null().to_numpy(zero_copy_only=False)

    def number(name: str, default: str = "0") -> npt.NDArray[np.int64]:
        cells = pc.fill_null(pc.struct_field(parts, name), default)
        cells = pc.utf8_rpad(cells, 9, "0") if name == "fraction" else pc.if_else(pc.equal(cells, ""), default, cells)
        return np.asarray(pc.cast(cells, pa.int64()).to_numpy(zero_copy_only=False), dtype=np.int64)

    years = (number("year", "1970") - 1970).astype("datetime64[Y]")
    months = years.astype("datetime64[M]") + (number("month", "1") - 1)
    days = (months.astype("datetime64[D]") + (number("day", "1") - 1)).astype(np.int64)
    whole = ((days * 24 + number("hour")) * 60 + number("minute")) * 60 + number("second")
    good = np.flatnonzero(~bad)
    since = 10**9 * (whole - (whole[good[0]] if good.size else 0)) + number("fraction")
    return np.where(bad, np.nan, 1e-9 * since)


# Between NumPy and Arrow through bare buffers: the ways of pyarrow import pandas, which costs half a second.


def from_numpy(values: npt.NDArray[Any]) -> Any:
    """Return an Arrow array without nulls that shares the memory of contiguous numbers."""
    import pyarrow as pa

    return pa.Array.from_buffers(
        pa.from_numpy_dtype(values.dtype), len(values), [None, pa.py_buffer(np.ascontiguousarray(values))]
    )


def repeated(text: str, count: int) -> Any:
    """Return a dictionary-encoded Arrow array that holds one text `count` times."""
    import pyarrow as pa

    content = text.encode()
    offsets = np.array([0, len(content)], np.int32)
    dictionary = pa.StringArray.from_buffers(1, pa.py_buffer(offsets), pa.py_buffer(content))
    return pa.DictionaryArray.from_arrays(from_numpy(np.zeros(count, np.int32)), dictionary)


def to_numpy(column: Any) -> npt.NDArray[np.float64]:
    """Return the numbers of a float64 Arrow column, NaN for nulls."""
    import pyarrow.compute as pc

    missing = from_numpy(np.array([np.nan]))[0]
    return np.asarray(np.from_dlpack(pc.fill_null(column, missing).combine_chunks()))
