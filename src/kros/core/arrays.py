"""Types of arrays, of names and of records, and objects that hold arrays."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, TypeVar, dataclass_transform

import numpy as np
from numpy.typing import ArrayLike as ArrayLike
from numpy.typing import NDArray

T = TypeVar("T")
AnyArray = NDArray[Any]
Array = NDArray[np.float64]
Bits = NDArray[np.uint8]
ByName = Mapping[str, Any]  # values by name, to be read
Columns = tuple[int, ...]  # positions of channels
Flags = NDArray[np.bool_]
Index = NDArray[np.intp]
Names = tuple[str, ...]  # and other texts
Parameters = Mapping[str, ArrayLike]  # of a lifting, by name
Record = dict[str, Any]  # values by name, as in JSON
Texts = dict[str, str]  # by name
Whole = NDArray[np.int64]


@dataclass_transform(frozen_default=True, eq_default=False)
def frozen(cls: type[T]) -> type[T]:
    """Make a class a frozen dataclass that is compared by identity: arrays have no one truth value."""
    return dataclass(frozen=True, eq=False)(cls)


def as_numbers(values: Any) -> Array:
    """Return an array of doubles, NaN for what is masked; text, complex numbers and dates are refused."""
    parts = values if isinstance(values, list | tuple) else [values]
    masked = any(isinstance(part, np.ma.MaskedArray) for part in parts)
    array = np.ma.asarray(values) if masked else np.asarray(values)
    mixed = array.dtype.kind == "O" and any(isinstance(v, (str, bytes, complex)) for v in array.ravel().tolist())
    if mixed or array.dtype.kind not in "biufO":
        raise TypeError(f"{'text or complex' if mixed else array.dtype} cannot be used as real numbers")
    return np.ma.filled(array.astype(float, copy=False), np.nan)
