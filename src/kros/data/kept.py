"""Episodes that were read, kept in memory up to a size: a study reads every one of them a dozen times."""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Callable, Hashable
from threading import Lock

import numpy as np
import numpy.typing as npt

Array = npt.NDArray[np.float64]


class Kept:
    """Arrays by key, those that were asked for last, at most so many bytes in all; they cannot be written to."""

    def __init__(self, limit: int) -> None:
        self.limit, self.size = limit, 0
        self.arrays: OrderedDict[Hashable, Array] = OrderedDict()
        self._lock = Lock()

    def take(self, key: Hashable, make: Callable[[], Array]) -> Array:
        """Return the array of a key, made where it is not there."""
        with self._lock:
            if key in self.arrays:
                self.arrays.move_to_end(key)
                return self.arrays[key]
        made = make()
        made.flags.writeable = False
        with self._lock:
            if made.nbytes <= self.limit and key not in self.arrays:
                self.arrays[key] = made
                self.size += made.nbytes
            while self.size > self.limit:
                self.size -= self.arrays.popitem(last=False)[1].nbytes
        return made
