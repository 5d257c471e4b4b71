"""Numbers from one table of text, fast, with errors that name the file and the column."""

from __future__ import annotations

import codecs
import csv
import gzip
import re
import zlib
from collections.abc import Collection, Iterator, Sequence
from contextlib import contextmanager
from itertools import groupby
from pathlib import Path
from typing import Any

import numpy as np
from pydantic import Field

from ...core import AnyArray, Array, DataError, Names, Settings, frozen, limits
from ...core.files import pass_on_shortage, require_regular, shortened
from ..measures import clean_unit, is_unit_row, split_header
from .formats import columns_of, is_binary, texts_of, values_of

# cells of spreadsheets without a number
ABSENT = ["-", "--", "---", "#DIV/0!", "#NUM!", "#REF!", "#VALUE!", "#WERT!", "#ZAHL!", "#BEZUG!", "#NV"]
BLOCK = 4 << 20  # bytes that Arrow parses at once; a line has to fit into two
HEAD = 1 << 18  # bytes of a file that say how it is written, and what its columns are called
TIMESTAMP_SCALE = 1e-6  # timestamps are read in microseconds, which doubles hold exactly
_STAMP = r"^\s*(?P<whole>.*?\d{1,2}:\d{2}:\d{2})(?:[.,:](?P<fraction>\d{1,9}))?\s*(?:Z|[+-]\d{2}:?\d{2})?\s*$"
ORDERS = ("ymd", "dmy", "mdy")  # of the date in a timestamp


class Dialect(Settings):
    """How a text file is written."""

    delimiter: str = Field(",", description="between columns; a tab is written `\\t`")
    header: bool = Field(True, description="false where the first line holds numbers; columns are then given by number")
    skip_rows: int = Field(0, ge=0, description="lines before the header, or before the first line of numbers")
    unit_rows: int = Field(0, ge=0, description="lines between the header and the numbers, such as units of measure")
    decimal: str = Field(".", description="decimal point, for example `,` in files of some countries")
    encoding: str = Field("utf-8", description="of the text, for example cp1252 or utf-16")


@frozen
class Table:
    """A table in a file."""

    path: Path
    dialect: Dialect  # of a text file
    fields: Names  # names of the columns, their numbers from 1 where there is no header
    units: Names  # units of measure that it states

    @classmethod
    def open(cls, path: Path, dialect: Dialect, wanted: Collection[str | int | None] = ()) -> Table:
        """Return the table of a file, of several the one that holds the wanted columns."""
        fields, units = (
            zip(*columns_of(path, wanted).items(), strict=True) if is_binary(path) else _columns(path, dialect)
        )
        return cls(path, dialect, tuple(fields), tuple(map(clean_unit, units)))

    def numbers(self, columns: Sequence[int], timestamp: str | None = None) -> Array:
        """Return some columns; the first may be timestamps, as microseconds."""
        if is_binary(self.path):
            return values_of(self.path, [self.fields[i] for i in columns])
        parts = [np.empty((0, len(columns)))]
        for time, *others in self._batches(columns, () if timestamp is None else columns[:1]):
            first = to_numpy(time) if timestamp is None else microseconds(time, timestamp)
            parts.append(np.column_stack([first, *map(to_numpy, others)]))
        return np.concatenate(parts)

    def texts(self, column: int) -> list[str]:
        """Return a column as text."""
        if is_binary(self.path):
            return texts_of(self.path, self.fields[column])
        return [str(text).strip() for (texts,) in self._batches([column], [column]) for text in texts.to_pylist()]

    def _batches(self, wanted: Sequence[int], texts: Collection[int]) -> Iterator[list[Any]]:
        """Yield columns as Arrow arrays of numbers, or of texts."""
        import pyarrow as pa
        from pyarrow import csv as arrow

        names, dialect = [str(i) for i in range(len(self.fields))], self.dialect
        kinds = {names[i]: pa.string() if i in texts else pa.float64() for i in wanted}
        lines = dialect.skip_rows + (1 + dialect.unit_rows if dialect.header else 0)
        options = (
            arrow.ReadOptions(use_threads=False, column_names=names, block_size=BLOCK, skip_rows=lines),
            arrow.ParseOptions(delimiter=dialect.delimiter),
            arrow.ConvertOptions(
                column_types=kinds,
                include_columns=list(kinds),
                decimal_point=dialect.decimal,
                null_values=[*arrow.ConvertOptions().null_values, *ABSENT],
            ),
        )
        try:
            with opened(self.path, dialect.encoding) as file:
                for batch in arrow.open_csv(pa.PythonFile(file, mode="r"), *options):
                    if file.tell() > limits.MAX_TEXT_BYTES:
                        raise DataError(
                            f"Reading {self.path}: unpacks to more than {limits.MAX_TEXT_BYTES} bytes; split it."
                        )
                    yield [batch.column(names[i]) for i in wanted]
        except DataError:
            raise
        except Exception as error:
            raise self._error(error) from error

    def _error(self, error: Exception) -> DataError:
        """Return what Arrow says about the file, with the name of a column in place of its number from zero."""

        def name(match: re.Match[str]) -> str:
            return f"in column {self.fields[int(match[1])]!r}:"

        pass_on_shortage(error, self.path)
        text = shortened(re.sub(r"In CSV column #(\d+):", name, str(error)))
        text = f"a line, or a text in quotes, is longer than {BLOCK} bytes" if "straddling" in text else text
        return DataError(f"Reading {self.path}: {text}; correct the file, or the mapping.")


def _columns(path: Path, dialect: Dialect) -> tuple[list[str], list[str]]:
    """Return the names of the columns of a text file, and the units that it states."""
    needed = dialect.skip_rows + dialect.unit_rows + 2
    lines = lines_of(head_of(path, 1000 * needed), dialect.encoding, path)
    lines = (lines if len(lines) > needed else lines_of(head_of(path), dialect.encoding, path))[dialect.skip_rows :]
    if not lines or not lines[0].strip():
        raise DataError(f"Reading {path}: it is empty, or has no line {dialect.skip_rows + 1}; correct skip_rows.")
    if "\0" in lines[0]:
        raise DataError(f"Reading {path}: holds NUL bytes, so it is binary or UTF-16; name the encoding.")
    try:
        fields, *rows = (cells_of(line, dialect.delimiter) for line in lines[: dialect.unit_rows + 2])
    except csv.Error as error:
        raise DataError(f"Reading {path}: its first line is no list of columns ({error}); correct the file.") from error
    width = len(rows[-1]) if dialect.header and len(rows) > dialect.unit_rows else len(fields)
    spare = (*fields[width:], *(rows[-1][len(fields) :] if width > len(fields) else ()))  # of delimiters at line ends
    fields = fields if width < 2 or any(spare) else (fields + [""] * width)[:width]
    if not dialect.header:
        return [str(i + 1) for i in range(len(fields))], [""] * len(fields)
    units = next(filter(is_unit_row, rows[: dialect.unit_rows]), [split_header(name)[1] for name in fields])
    return fields, (units + [""] * len(fields))[: len(fields)]


def head_of(path: Path, size: int = HEAD) -> bytes:
    """Return the first bytes of a text file, without a last line that is cut."""
    with opened(path) as file:
        content: bytes = file.read(size)
    ends = max(content.rfind(b"\n"), content.rfind(b"\r"))
    if len(content) < size or b"\0" in content:
        return content
    if ends < 0 and size == HEAD:
        raise DataError(f"Reading {path}: a line at the start is longer than {HEAD} bytes; it is no table of text.")
    return content[: ends + 1]


def lines_of(content: bytes, encoding: str, path: Path) -> list[str]:
    """Return the first lines of a file; the last character may be cut."""
    try:
        text = codecs.getincrementaldecoder(encoding)().decode(content)
    except UnicodeError as error:
        raise DataError(f"Reading {path}: not {encoding.upper()} ({error}); is it cp1252, UTF-16?") from error
    return re.split("\r\n|\r|\n", re.sub("(\r\n|\r|\n)\\Z", "", text.removeprefix("\ufeff")))


def cells_of(line: str, delimiter: str) -> list[str]:
    """Return the cells of a line, without surrounding space and quotes."""
    return [cell.strip() for cell in next(csv.reader([line], delimiter=delimiter, skipinitialspace=True), [])]


def stretches(columns: Sequence[Sequence[Any]]) -> Iterator[tuple[tuple[Any, ...], slice]]:
    """Yield what columns hold where they stay the same, and these rows."""
    start = 0
    for state, rows in groupby(zip(*columns, strict=True)):
        start, first = start + sum(1 for _ in rows), start
        yield state, slice(first, start)


@contextmanager
def opened(path: Path, encoding: str = "utf-8") -> Iterator[Any]:
    """Open a regular text file, unpacked where it ends in ``.gz``, as UTF-8."""
    require_regular(path, limits.MAX_TEXT_BYTES)
    opener: Any = gzip.open if path.suffix == ".gz" else open
    try:
        with opener(path, "rb") as file:
            is_utf8 = codecs.lookup(encoding).name == "utf-8"
            yield file if is_utf8 else codecs.EncodedFile(file, "utf-8", encoding)
    except (OSError, EOFError, zlib.error, UnicodeError) as error:
        raise DataError(f"Reading {path}: cannot be read ({error}); check the file, or restore it.") from error


def microseconds(column: Any, order: str) -> Array:
    """Return an Arrow array of timestamps, or of times of day, in microseconds, NaN where there is none."""
    import pyarrow as pa
    import pyarrow.compute as pc

    parts = pc.extract_regex(column, pattern=_STAMP)
    whole = pc.replace_substring_regex(pc.struct_field(parts, "whole"), pattern="[-./T ]+", replacement="-")
    date = "-".join(f"%{letter}" for letter in order.replace("y", "Y"))
    forms = (f"{date}-%H:%M:%S", "%H:%M:%S")
    time = pc.coalesce(*(pc.strptime(whole, format=f, unit="s", error_is_null=True) for f in forms))
    fraction = pc.cast(pc.binary_join_element_wise("0.", pc.struct_field(parts, "fraction"), ""), pa.float64())
    seconds = pc.cast(pc.cast(time, pa.int64()), pa.float64())
    return to_numpy(seconds) / TIMESTAMP_SCALE + np.nan_to_num(to_numpy(fraction)) / TIMESTAMP_SCALE


# Between NumPy and Arrow through bare buffers: the ways of pyarrow import pandas, which costs half a second.


def from_numpy(values: AnyArray) -> Any:
    """Return an Arrow array without nulls that shares the memory of contiguous numbers."""
    import pyarrow as pa

    content = pa.py_buffer(np.ascontiguousarray(values))
    return pa.Array.from_buffers(pa.from_numpy_dtype(values.dtype), len(values), [None, content])


def repeated(text: str, count: int) -> Any:
    """Return a dictionary-encoded Arrow array that holds one text `count` times."""
    import pyarrow as pa

    content = text.encode()
    offsets = pa.py_buffer(np.array([0, len(content)], np.int32))
    dictionary = pa.StringArray.from_buffers(1, offsets, pa.py_buffer(content))
    return pa.DictionaryArray.from_arrays(from_numpy(np.zeros(count, np.int32)), dictionary)


def to_numpy(column: Any) -> Array:
    """Return the numbers of a float64 Arrow array, or of a column of chunks, NaN for nulls."""
    import pyarrow.compute as pc

    filled = pc.fill_null(column, from_numpy(np.array([np.nan]))[0]) if column.null_count else column
    return np.asarray(np.from_dlpack(filled.combine_chunks() if hasattr(filled, "chunks") else filled))
