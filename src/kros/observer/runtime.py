"""Delay of measurements, limits, and the largest sizes seen in training: data of the machine that an observer runs on."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from ..core.errors import DataError, DimensionError

Array = npt.NDArray[np.float64]


@dataclass(frozen=True, eq=False)
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
        for name in ("measured", "inputs"):
            values = np.atleast_1d(np.asarray(getattr(self, name), dtype=float))
            object.__setattr__(self, name, values)
            if values.ndim != 1 or not np.isfinite(values).all() or np.any(values < 0):
                raise DataError(
                    f"Sizes seen in training: {name} should be one finite size of at least 0 a channel, found {values}."
                )

    def times(self, measured: Array, inputs: Array) -> Seen:
        """Return the sizes in other units of measure, by the factors of measurements, shape (q,), and inputs, shape (m,)."""
        return Seen(self.measured * measured, self.inputs * inputs)


@dataclass(frozen=True, eq=False)
class Runtime:
    """Delay and limits of a running observer.

    Parameters
    ----------
    delay : int
        Samples by which measurements are delayed: what arrives at k was measured at ``k - delay``. The estimate is corrected as of then and
        predicted forward through the model.
    lower, upper : ndarray, shape (n,), optional
        Limits of the estimate, state by state.
    relift : bool
        Whether the observer goes on from its estimate within the limits; otherwise these only cut off what it gives out. A model of a machine under
        control need not be stable with a state that is stuck: what is cut off is safe for every observer, the other for one that was made for it.
    correction : ndarray, shape (width,), optional
        Largest size of every correction.
    input_lower, input_upper : ndarray, shape (m,), optional
        Limits of the recorded inputs. What is beyond them is taken at the limit, as measurements are beyond the limits of their states.

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
    correction: Array | None = None
    input_lower: Array | None = None
    input_upper: Array | None = None
    relift: bool = True

    def __post_init__(self) -> None:
        if int(self.delay) != self.delay or self.delay < 0:
            raise DataError(
                f"Runtime of an observer: the delay of {self.delay} should be a whole number of samples, at least 0."
            )
        for name in _ARRAYS:
            value = getattr(self, name)
            if value is not None:
                object.__setattr__(self, name, np.asarray(value, dtype=float))
                if np.isnan(getattr(self, name)).any():
                    raise DataError(
                        f"Runtime of an observer: {name} contains what is not a number; leave limits out, or make them infinite."
                    )
        for lower, upper in ((self.lower, self.upper), (self.input_lower, self.input_upper)):
            if lower is not None and upper is not None and np.any(lower > upper):
                raise DataError(
                    f"Runtime of an observer: lower limits {lower} should not exceed the upper ones {upper}."
                )
        if self.correction is not None and np.any(self.correction < 0):
            raise DataError(f"Runtime of an observer: the largest corrections {self.correction} should be positive.")

    @property
    def limited(self) -> bool:
        """Whether a step meets limits."""
        return self.correction is not None or (
            self.relift and any(side is not None for side in (self.lower, self.upper))
        )

    @property
    def binding(self) -> bool:
        """Whether there is any limit that an estimate or a correction may meet."""
        return any(limit is not None for limit in (self.correction, self.lower, self.upper))

    def limited_states(self, n: int) -> list[int]:
        """Return which of n states have limits."""
        sides = [np.isfinite(side) for side in (self.lower, self.upper) if side is not None]
        return [int(i) for i in np.flatnonzero(np.any(sides, axis=0))] if sides else []

    def clipped_states(self, n: int) -> list[int]:
        """Return which of n states an observer goes on from within their limits."""
        return self.limited_states(n) if self.relift else []

    def limited_corrections(self, into: Array) -> list[int]:
        """Return which corrections have a limit and reach a state; `into`, shape (n, width), is where they enter."""
        return (
            []
            if self.correction is None
            else [int(i) for i in np.flatnonzero(np.isfinite(self.correction) & np.any(into, axis=0))]
        )

    def binds(self, x: Array, y_c: Array | None) -> bool:
        """Whether an estimate, shape (n,), meets a limit, or a correction, shape (width,), exceeds one; None where corrections have none."""
        at = [
            limit is not None and np.any(meets(limit))
            for limit, meets in ((self.lower, x.__le__), (self.upper, x.__ge__))
        ]
        return bool(any(at)) or (
            self.correction is not None and y_c is not None and bool(np.any(np.abs(y_c) > self.correction))
        )

    def clips_alike(self, other: Runtime) -> bool:
        """Whether two observers' estimates have the same limits, and their corrections none."""
        pairs = ((self.lower, other.lower), (self.upper, other.upper))
        same = all(a is b or (a is not None and b is not None and np.array_equal(a, b)) for a, b in pairs)
        return same and self.relift == other.relift and self.correction is None and other.correction is None

    def clip_estimate(self, x: Array) -> Array:
        """Return estimates within their limits, shape (..., n)."""
        if self.lower is None and self.upper is None:
            return x
        return np.asarray(np.clip(x, self.lower, self.upper))

    def clip_estimates(self, x: Array) -> None:
        """Bring estimates, shape (..., n), within their limits where they are."""
        for i in self.limited_states(x.shape[-1]):
            low, high = (
                none if side is None else side[i] for side, none in ((self.lower, -np.inf), (self.upper, np.inf))
            )
            np.clip(x[..., i], low, high, out=x[..., i])

    def within(self, states: Array) -> Array:
        """Return recorded states, shape (..., n_recorded), within the limits that they have."""
        low, high = (side if side is None else side[: states.shape[-1]] for side in (self.lower, self.upper))
        return states if low is None and high is None else np.asarray(np.clip(states, low, high))

    def relifted(self, x: Array) -> Array:
        """Return the estimates that an observer goes on from, shape (..., n)."""
        return self.clip_estimate(x) if self.relift else x

    def clip_correction(self, y_c: Array) -> Array:
        """Return corrections within their limits, shape (..., width)."""
        return y_c if self.correction is None else np.asarray(np.clip(y_c, -self.correction, self.correction))

    def clip_inputs(self, u: Array) -> Array:
        """Return inputs within their limits, shape (..., m)."""
        return (
            u
            if self.input_lower is None and self.input_upper is None
            else np.asarray(np.clip(u, self.input_lower, self.input_upper))
        )

    def require_fit(self, name: str, n: int, width: int, m: int) -> None:
        """Refuse limits of another size than the observer's."""
        wanted = {"lower": (n,), "upper": (n,), "correction": (width,), "input_lower": (m,), "input_upper": (m,)}
        for key, shape in wanted.items():
            value = getattr(self, key)
            if value is not None and value.shape != shape:
                raise DimensionError(f"Observer {name}: runtime.{key} should have shape {shape}, found {value.shape}.")

    def content(self) -> dict[str, Any]:
        """Return what an observer's file holds of it: nothing where everything is as by default."""
        arrays = {name: getattr(self, name) for name in _ARRAYS if getattr(self, name) is not None}
        found: dict[str, Any] = ({"delay": int(self.delay)} if self.delay else {}) | (
            {} if self.relift else {"relift": False}
        )
        found |= {k: _finite(v) for k, v in arrays.items()}
        return {"runtime": found} if found else {}

    @classmethod
    def from_content(cls, content: Mapping[str, Any]) -> Runtime:
        """Read what `content` returned; a limit that is null is infinite."""
        found = dict(content.get("runtime", {}))
        for name in _ARRAYS:
            if name in found:
                values = np.array(found[name], dtype=object)
                values[values == None] = -np.inf if name.endswith("lower") else np.inf  # noqa: E711
                found[name] = values.astype(float)
        return cls(**found)


_ARRAYS = ("lower", "upper", "correction", "input_lower", "input_upper")


def _finite(value: Array) -> list[Any]:
    """JSON has no infinity: null stands for it."""
    plain = value.astype(object)
    plain[~np.isfinite(value)] = None
    nested: list[Any] = plain.tolist()
    return nested
