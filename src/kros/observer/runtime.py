"""Delay, limits, guard and ranges: data of the machine that an observer runs on."""

from __future__ import annotations

import numpy as np

from ..core import Array, DataError, Flags, frozen
from .checked import floats


@frozen
class Seen:
    """The largest sizes seen in training.

    Parameters
    ----------
    measured : ndarray, shape (q,)
        Largest absolute value of every measurement; a channel that was always zero has no range.
    inputs : ndarray, shape (m,)
        Of every recorded input.

    Raises
    ------
    DataError
        When a size is negative or not finite.

    Examples
    --------
    >>> import numpy as np
    >>> from kros.observer import Seen
    >>> Seen(measured=np.array([3.1]), inputs=np.array([1.0])).measured.tolist()
    [3.1]
    """

    measured: Array
    inputs: Array

    def __post_init__(self) -> None:
        floats(self, "Sizes seen in training", **dict.fromkeys(vars(self), "finite and not negative"))


@frozen
class Runtime:
    """Delay, limits and start of a running observer.

    Parameters
    ----------
    delay : int
        Samples by which measurements are delayed: what arrives at k was measured at ``k - delay``. The estimate is
        corrected as of then and predicted forward through the model.
    lower, upper : ndarray, shape (n,), optional
        Limits of the estimates that are given out, state by state. The observer goes on from its estimate without
        them: a model of a machine under control need not be stable with a state that is stuck.
    start : ndarray, shape (n,), optional
        First estimate of states, of measured ones where their measurement is missing; zero by default.

    Raises
    ------
    DataError
        When the delay is negative, or a limit is not a number or crosses its partner.

    Examples
    --------
    >>> import numpy as np
    >>> from kros.observer import Runtime
    >>> runtime = Runtime(delay=2, upper=np.array([np.inf, 1.0]))  # the second state has a limit
    >>> runtime.delay, runtime.upper.tolist()
    (2, [inf, 1.0])
    """

    delay: int = 0
    lower: Array | None = None
    upper: Array | None = None
    start: Array | None = None

    def __post_init__(self) -> None:
        what = "Runtime of an observer"
        if int(self.delay) != self.delay or self.delay < 0:
            raise DataError(f"{what}: the delay of {self.delay} should be a whole number of samples, at least 0.")
        floats(self, what, **dict.fromkeys(self.by_state(), "numbers"))
        if self.lower is not None and self.upper is not None and np.any(self.lower > self.upper):
            raise DataError(f"{what}: lower limits {self.lower} should not exceed the upper ones {self.upper}.")

    def by_state(self) -> dict[str, Array]:
        """Return what there is of every state, by name."""
        return {name: values for name, values in vars(self).items() if name != "delay" and values is not None}

    def first(self, n: int) -> Array:
        """Return the first estimate of n states before any measurement."""
        return np.zeros(n) if self.start is None else self.start

    def sides(self, n: int) -> tuple[Array, Array]:
        """Return lower and upper limits of the first n states, infinite where there are none."""
        low, high = np.full((2, n), [[-np.inf], [np.inf]])
        return low if self.lower is None else self.lower[:n], high if self.upper is None else self.upper[:n]

    def binds(self, x: Array) -> Flags:
        """Return which estimates, (..., n), meet a limit."""
        low, high = self.sides(x.shape[-1])
        return np.asarray(((x <= low) | (x >= high)).any(axis=-1))

    def clip_estimate(self, x: Array) -> None:
        """Bring estimates or recorded states, the first ones, (..., n), within their limits, in place."""
        np.clip(x, *self.sides(x.shape[-1]), out=x)


@frozen
class Guard:
    """Bounds of an observer's states: a step beyond them is not taken, the next good sample starts it again."""

    lower: Array  # (n,), of the estimate, internal states included
    upper: Array
    correction: Array  # (n_c,), largest size of every state of the correction
    settle: int  # samples after a start until the estimate is as good as before

    def __post_init__(self) -> None:
        what = "Guard of an observer"
        floats(self, what, lower="numbers", upper="numbers", correction="positive")
        if not (np.all(self.lower < self.upper) and self.settle >= 0):
            raise DataError(
                f"{what}: lower bounds {self.lower} should be below the upper ones {self.upper}, and {self.settle} "
                "samples to settle at least 0."
            )


def bounds(guard: Guard | None, n: int, order: int) -> tuple[Array, Array]:
    """Return the bounds of [x; x^c], (n + order,): products of what is within are finite."""
    most = np.full(n + order, float(np.sqrt(np.finfo(float).max)))
    if guard is None:
        return -most, most
    low, high = np.append(guard.lower, -guard.correction), np.append(guard.upper, guard.correction)
    return np.maximum(low, -most), np.minimum(high, most)
