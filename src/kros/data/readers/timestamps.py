"""Timestamps of text as seconds."""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt

CLOCK = r"(?P<hour>\d{1,2}):(?P<minute>\d{2}):(?P<second>\d{2})(?:[.,:](?P<fraction>\d{1,9}))?(?:Z|[+-]\d{2}:?\d{2})?"
DATES = {
    "ymd": r"(?P<year>\d{4})[-./](?P<month>\d{1,2})[-./](?P<day>\d{1,2})",
    "dmy": r"(?P<day>\d{1,2})[-./](?P<month>\d{1,2})[-./](?P<year>\d{4})",
    "mdy": r"(?P<month>\d{1,2})[-./](?P<day>\d{1,2})[-./](?P<year>\d{4})",
}


def pattern(order: str) -> str:
    """Return the regular expression of timestamps with a date in some order, ``ymd``, ``dmy`` or ``mdy``, or without a date."""
    return rf"^\s*(?:{DATES[order]}[T ]\s*)?{CLOCK}\s*$"


def seconds_of(column: Any, order: str) -> npt.NDArray[np.float64]:
    """Return timestamps as seconds since the first one, NaN where a cell holds none, shape (n_rows,), s."""
    import pyarrow as pa
    import pyarrow.compute as pc

    text = column.combine_chunks() if isinstance(column, pa.ChunkedArray) else column
    parts = pc.extract_regex(text, pattern=pattern(order))
    bad = parts.is_null().to_numpy(zero_copy_only=False)

    def number(name: str, default: str = "0") -> npt.NDArray[np.int64]:
        cells = pc.fill_null(pc.struct_field(parts, name), default)
        numbers = pc.cast(pc.if_else(pc.equal(cells, ""), default, cells), pa.int64()).to_numpy(zero_copy_only=False)
        return np.asarray(numbers, dtype=np.int64)

    months = (number("year", "1970") - 1970).astype("datetime64[Y]").astype("datetime64[M]") + (
        number("month", "1") - 1
    )
    days = (months.astype("datetime64[D]") + (number("day", "1") - 1)).astype(np.int64)
    fraction = pc.fill_null(pc.struct_field(parts, "fraction"), "")
    nanoseconds = np.asarray(
        pc.cast(pc.utf8_rpad(fraction, 9, "0"), pa.int64()).to_numpy(zero_copy_only=False), dtype=np.int64
    )
    whole = ((days * 24 + number("hour")) * 60 + number("minute")) * 60 + number("second")
    good = np.flatnonzero(~bad)
    since = 10**9 * (whole - (whole[good[0]] if good.size else 0)) + nanoseconds
    return np.where(bad, np.nan, 1e-9 * since)
