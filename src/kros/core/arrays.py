"""Types of arrays, for annotations."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import ArrayLike as ArrayLike
from numpy.typing import NDArray

AnyArray = NDArray[Any]
Array = NDArray[np.float64]
Bits = NDArray[np.uint8]
Flags = NDArray[np.bool_]
Index = NDArray[np.intp]
Parameters = Mapping[str, ArrayLike]  # of a lifting, by name
Whole = NDArray[np.int64]
