"""Arrays of the parts of an observer, checked where they enter."""

from __future__ import annotations

from typing import Any

import numpy as np

from ..core import DataError

LARGEST = float(np.finfo(float).max)
RANGES = {
    "numbers": (-np.inf, np.inf),
    "finite numbers": (-LARGEST, LARGEST),
    "finite and not negative": (0.0, LARGEST),
    "positive": (float(np.finfo(float).tiny), np.inf),
    "positive and finite": (float(np.finfo(float).tiny), LARGEST),
    "shares between 0 and 1": (0.0, 1.0),
}


def floats(part: Any, what: str, **kinds: str) -> None:
    """Make fields of a frozen dataclass arrays, of one dimension at least, and refuse numbers of another kind."""
    for name, kind in kinds.items():
        values = np.atleast_1d(np.asarray(getattr(part, name), dtype=float))
        low, high = RANGES[kind]
        if not ((values >= low) & (values <= high)).all():
            raise DataError(f"{what}: {name} should be {kind}, found {values.tolist()}.")
        object.__setattr__(part, name, values)
