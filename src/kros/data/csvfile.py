"""Numbers from one delimited text file, fast, with errors that name the file and the column."""

from __future__ import annotations

import csv
import gzip
import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import numpy.typing as npt

from ..core.errors import DataError
from .arrow import fill


@dataclass(frozen=True)
class Dialect:
    """How a file is written: delimiter, whether a line names the columns, lines to skip before it, and the decimal point."""

    delimiter: str = ","
    header: bool = True
    skip: int = 0
    decimal: str = "."


COMMA = Dialect()


def first_fields(path: Path, dialect: Dialect = COMMA) -> list[str]:
    """Return the fields of the first line after those skipped, without surrounding space and quotes."""
    opener = gzip.open if path.suffix == ".gz" else open
    try:
        with opener(path, "rb") as file:
            for _ in range(dialect.skip):
                file.readline()
            line = file.readline().decode("utf-8-sig").rstrip("\r\n")
    except (OSError, UnicodeDecodeError) as error:
        raise DataError(f"Reading {path}: cannot read its first line ({error}); check the file.") from error
    if not line.strip():
        raise DataError(f"Reading {path}: the file is empty or starts with an empty line; remove it or restore it.")
    return [part.strip() for part in next(csv.reader([line], delimiter=dialect.delimiter, skipinitialspace=True))]


def read_columns(path: Path, names: Sequence[str], wanted: Sequence[str], dialect: Dialect = COMMA) -> npt.NDArray[np.float64]:
    """Read some columns of a file.

    Parameters
    ----------
    path : Path
        ``.csv`` or ``.csv.gz``.
    names : sequence of str
        Names of all columns, in order.
    wanted : sequence of str
    dialect : Dialect

    Returns
    -------
    ndarray, shape (len(wanted), n_rows)
        One contiguous row per column of the file; empty cells are NaN.

    Raises
    ------
    DataError
        A missing file, a row with more or fewer columns, or a cell that is not a number.
    """
    import pyarrow as pa
    from pyarrow import csv as arrow

    read = arrow.ReadOptions(use_threads=False, skip_rows=dialect.skip + dialect.header, column_names=list(names), block_size=1 << 22)
    parse = arrow.ParseOptions(delimiter=dialect.delimiter)
    numbers = {name: pa.float64() for name in wanted}
    convert = arrow.ConvertOptions(column_types=numbers, include_columns=list(numbers), decimal_point=dialect.decimal)
    try:
        table = arrow.read_csv(path, read, parse, convert)
    except (pa.ArrowInvalid, pa.ArrowKeyError) as error:
        if "Empty CSV" in str(error):
            return np.zeros((len(wanted), 0))
        raise DataError(f"Reading {path}: {_explain(str(error), names)}; correct the file.") from error
    except OSError as error:
        raise DataError(f"Reading {path}: {error}; check that the file exists and can be read.") from error
    values = np.empty((len(wanted), table.num_rows))
    for row, name in enumerate(wanted):
        fill(values[row], table.column(name))
    return values


def _explain(message: str, names: Sequence[str]) -> str:
    """Return Arrow's message, with the number of a column (from zero, in the file) replaced by its name."""
    return re.sub(r"In CSV column #(\d+):", lambda match: f"in column {names[int(match[1])]!r}:", message)
