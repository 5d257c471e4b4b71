"""Between NumPy and Arrow through bare buffers.

`pyarrow.array` and `to_numpy` import pandas wherever it is installed, which costs every process more than half a
second; these do not.
"""

from __future__ import annotations

from functools import lru_cache
from typing import Any

import numpy as np
import numpy.typing as npt


def from_numpy(values: npt.NDArray[Any]) -> Any:
    """Return an Arrow array without nulls that shares the memory of contiguous numbers."""
    import pyarrow as pa

    kind = {"float64": pa.float64(), "int64": pa.int64(), "int32": pa.int32()}[values.dtype.name]
    return pa.Array.from_buffers(kind, len(values), [None, pa.py_buffer(np.ascontiguousarray(values))])


@lru_cache(maxsize=8)  # episodes of one length, one behind the other
def repeated(text: str, count: int) -> Any:
    """Return a dictionary-encoded Arrow array that holds one text `count` times."""
    import pyarrow as pa

    content = text.encode()
    offsets = np.array([0, len(content)], np.int32)
    dictionary = pa.StringArray.from_buffers(1, pa.py_buffer(offsets), pa.py_buffer(content))
    return pa.DictionaryArray.from_arrays(from_numpy(np.zeros(count, np.int32)), dictionary)


def fill(out: npt.NDArray[np.float64], column: Any) -> None:
    """Copy a float64 Arrow column of the same length into `out`; nulls become NaN."""
    start = 0
    for chunk in column.chunks:
        n, (validity, data) = len(chunk), chunk.buffers()
        part = out[start : start + n]
        if n:
            part[:] = np.frombuffer(data, np.float64, n, 8 * chunk.offset)
        if chunk.null_count:
            bits = np.unpackbits(np.frombuffer(validity, np.uint8), bitorder="little")
            part[bits[chunk.offset : chunk.offset + n] == 0] = np.nan
        start += n
