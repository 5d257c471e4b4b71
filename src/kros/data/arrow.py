"""Between NumPy and Arrow through bare buffers: the ways of pyarrow import pandas, which costs half a second."""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt


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
