"""Columns of anybody's Parquet file, one episode a file; kros's own format is read by `kros.data.readers.parquet`."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from ...core import limits
from ...core.errors import DataError
from ...core.files import require_regular, shortened
from ...core.memory import pass_on_shortage
from ..arrow import fill


def parquet_fields(path: Path) -> list[str]:
    """Return the names of a file's columns."""
    from pyarrow import parquet

    require_regular(path, sys.maxsize)
    try:
        return list(parquet.read_schema(path).names)
    except (OSError, ValueError) as error:
        raise DataError(
            f"Reading {path}: no Parquet file that can be read ({shortened(str(error))}); check the file."
        ) from error


def parquet_columns(path: Path, wanted: Sequence[str], timestamp: bool = False) -> npt.NDArray[np.float64]:
    """Read some columns of a file; with `timestamp` the first of them in seconds since its first row, shape (len(wanted), n_rows)."""
    import pyarrow as pa
    from pyarrow import parquet

    require_regular(path, sys.maxsize)
    try:
        if parquet.read_metadata(path).num_rows > limits.MAX_SAMPLES:
            raise DataError(
                f"Reading {path}: has more than {limits.MAX_SAMPLES} rows; cut it, or raise MAX_SAMPLES in kros.core.limits."
            )
        table = parquet.ParquetFile(path).read(columns=list(wanted), use_threads=False)
        values = np.empty((len(wanted), table.num_rows))
        for i, name in enumerate(wanted):
            column = table.column(name)
            fill(values[i], _seconds(column) if timestamp and i == 0 else column.cast(pa.float64()))
        return values
    except DataError:
        raise
    except (OSError, ValueError, LookupError, MemoryError, NotImplementedError) as error:  # and Arrow's own
        pass_on_shortage(error, path)
        raise DataError(f"Reading {path}: {shortened(str(error))}; correct the file, or the mapping.") from error


def _seconds(column: Any) -> Any:
    import pyarrow as pa
    import pyarrow.compute as pc

    since = column.cast(pa.timestamp("ns")).cast(pa.int64())
    whole = pc.subtract(since, pc.min(since))
    return pc.multiply(whole.cast(pa.float64()), 1e-9)


def parquet_head(path: Path) -> tuple[list[str], list[tuple[str, ...]]]:
    """Return the names of a file's columns, and its first rows as text; text and dates of columns that hold no numbers are no numbers."""
    from pyarrow import parquet

    fields = parquet_fields(path)
    batch = next(parquet.ParquetFile(path).iter_batches(batch_size=60), None)
    columns = (
        [] if batch is None else [["" if v is None else str(v) for v in column.to_pylist()] for column in batch.columns]
    )
    return fields, list(zip(*columns, strict=True))
