"""The guard: between which values an observer's states stay; where one leaves them, or is no number, the observer starts again at the next good sample.

An observer is stable with the measurements that it was made for. Without some of them it runs on its own predictions, which may grow. The guard
stops that: the step that would leave the bounds is not taken, the estimate stands still, and at the next sample with a measurement and all inputs the
observer starts as it did at first. `SampleStatus.RESTARTED` is set from there on until the start has settled.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import numpy.typing as npt

from ..core.errors import DataError, DimensionError

Array = npt.NDArray[np.float64]
_MOST = float(np.sqrt(np.finfo(float).max))  # products of what is within are finite


@dataclass(frozen=True, eq=False)
class Guard:
    """Bounds of the states of an observer, and how long a start takes.

    Parameters
    ----------
    lower, upper : ndarray, shape (n,)
        Of the estimate, internal states included.
    correction : ndarray, shape (n_c,)
        Largest size of every state of the correction.
    settle : int
        Samples after a start until the estimate is as good as before.

    Raises
    ------
    DataError
        When a bound is not a number, a lower one is not below its partner, or `settle` is negative.

    Examples
    --------
    >>> import numpy as np
    >>> from kros.observer import Guard
    >>> Guard(np.array([-2.0]), np.array([2.0]), np.zeros(0), settle=50).upper.tolist()
    [2.0]
    """

    lower: Array
    upper: Array
    correction: Array
    settle: int

    def __post_init__(self) -> None:
        for name in ("lower", "upper", "correction"):
            object.__setattr__(self, name, np.atleast_1d(np.asarray(getattr(self, name), dtype=float)))
        if not (np.all(self.lower < self.upper) and np.all(self.correction > 0) and self.settle >= 0):
            raise DataError(
                f"Guard of an observer: lower bounds {self.lower} should be below the upper ones {self.upper}, sizes {self.correction} of the "
                f"correction above zero, and {self.settle} samples to settle at least 0."
            )

    def times(self, x: Array) -> Guard:
        """Return the guard of states multiplied by factors, shape (n,); states of the correction stay."""
        return replace(self, lower=self.lower * x, upper=self.upper * x)

    def turned(self, turn: Array) -> Guard:
        """Return the smallest box around the states ``turn @ x``, shape (n, n)."""
        middle, half = turn @ (self.lower + self.upper) / 2, np.abs(turn) @ (self.upper - self.lower) / 2
        return replace(self, lower=middle - half, upper=middle + half)

    def require_fit(self, name: str, n: int, order: int) -> None:
        """Refuse bounds of another size than the observer's."""
        found = (self.lower.shape, self.upper.shape, self.correction.shape)
        if found != ((n,), (n,), (order,)):
            raise DimensionError(
                f"Observer {name}: a guard of {n} states and {order} of the correction is needed, found shapes {found}."
            )

    def content(self) -> dict[str, Any]:
        """Return what an observer's file holds of it."""
        return {"lower": self.lower, "upper": self.upper, "correction": self.correction, "settle": self.settle}

    @classmethod
    def from_content(cls, content: Mapping[str, Any]) -> Guard:
        """Read what `content` returned."""
        return cls(**content)


def bounds(guard: Guard | None, n: int, order: int) -> tuple[Array, Array]:
    """Return the bounds of [x; x^c] with a correction of some order, of which none says more than the guard; without one, what is finite is within."""
    high = np.full(n + order, _MOST)
    if guard is None:
        return -high, high
    own = n + len(guard.correction)
    low = -high
    high[:own] = np.minimum(np.append(guard.upper, guard.correction), _MOST)
    low[:own] = np.maximum(np.append(guard.lower, -guard.correction), -_MOST)
    return low, high


class Restarts:
    """Counts down, over a batch of machines, until their starts have settled."""

    def __init__(self, guard: Guard | None, batch: int) -> None:
        self._settle, self._left = 0 if guard is None else guard.settle, np.zeros(batch, dtype=int)

    def after(self, waiting: npt.NDArray[np.bool_]) -> npt.NDArray[np.bool_]:
        """Return which machines wait for a start after a step, or have not settled since."""
        found = waiting | (self._left > 0)
        self._left = np.where(waiting, self._settle, np.maximum(self._left - 1, 0))
        return found
