"""An observer with its state, for one machine, sample by sample."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from ..core import AnyArray, Array, ArrayLike, DimensionError, Names
from .data import ObserverData
from .screen import Held, SampleStatus, Screen, Screened, numbers
from .simulate import Course, stepped
from .step import forward
from .tracking import PhaseLockedLoop


class Estimate(dict[str, float]):
    """Estimated states by name, those that recordings hold; ``np.asarray(estimate)`` has shape (n,).

    Examples
    --------
    >>> import numpy as np
    >>> from kros.lifting import Lifting
    >>> from kros.observer import Observer
    >>> observer = Observer.open_loop("lag", Lifting(("x", "v")), 0.5 * np.eye(2), np.ones((2, 1)), (0,), ("u",), 0.01)
    >>> estimate = observer.start([1.0]).step([1.0], [0.25])
    >>> estimate["v"], np.asarray(estimate).tolist()
    (0.25, [0.75, 0.25])
    """

    def __array__(self, dtype: Any = None, copy: bool | None = None) -> AnyArray:
        return np.array([*self.values()], dtype=dtype, copy=copy)

    def __repr__(self) -> str:
        return f"Estimate({', '.join(f'{name}={value:g}' for name, value in self.items())})"


class RunningObserver:
    """An observer with its state, for one machine.

    Parameters
    ----------
    observer : ObserverData
    y : ndarray, shape (q,)
        First measurement.
    parameters : mapping of str to float
        The machine's own lifting parameters; others may be assigned between steps.

    Examples
    --------
    >>> import numpy as np
    >>> from kros.lifting import Lifting
    >>> from kros.observer import Observer, SampleStatus
    >>> observer = Observer.open_loop("lag", Lifting(("x", "v")), 0.5 * np.eye(2), np.ones((2, 1)), (0,), ("u",), 0.01)
    >>> running = observer.start([1.0])
    >>> running.step([np.nan], [0.25])["x"], SampleStatus(running.status) == SampleStatus.MISSING
    (0.75, True)
    """

    def __init__(self, observer: ObserverData, y: ArrayLike, parameters: Mapping[str, float]) -> None:
        self.observer = observer
        self._screen = Screen.of(observer)
        self._course = Course(observer, 1, parameters, watched=True)
        self.parameters = parameters
        self.reset(y)

    @property
    def states(self) -> Names:
        """Names of the estimated states, in order."""
        return self.observer.recorded

    @property
    def parameters(self) -> Mapping[str, float]:
        """The machine's lifting parameters; an unknown name, or a value that is not finite, is refused."""
        return dict(self._course.values)

    @parameters.setter
    def parameters(self, values: Mapping[str, float]) -> None:
        """Change all of them; the nominal unit's stand for others."""
        self._course.values = self._course.steps.values = self.observer.values(values, ())

    def track(self, name: str, settle_s: float | None = None) -> None:
        """Let one of the parameters follow the machine from now on (`PhaseLockedLoop`).

        Raises
        ------
        ConfigError
            When the observer has no such parameter, or has delays.
        """
        self._course.loop = PhaseLockedLoop(self.observer, name, 1, settle_s)

    @property
    def status(self) -> SampleStatus:
        """What was wrong with the last sample, or with the first measurement before there was one."""
        return self._status

    @property
    def level_db(self) -> float | None:
        """Level of the innovation over its bound in dB, above zero outside; None without a monitor."""
        return None if self._course.watch is None else self._course.watch.level_db

    def reset(self, y: ArrayLike) -> None:
        """Start again at a measurement, shape (q,); nothing of the past is left, the parameters stay."""
        first = self._sample(y, np.zeros(len(self.observer.inputs)))
        self._status = SampleStatus(int(first.status[0, 0]))
        self._fresh = self.observer.bank is not None or bool(self._screen.enough(np.isfinite(first.y)).all())
        self._course.begin(first)

    @property
    def estimate(self) -> Estimate:
        """One-step prediction: the state at k from what arrived up to k - 1."""
        return self._forward(self._course.steps.x)

    def filter(self, y: ArrayLike) -> Estimate:
        """Return the estimate for k from what arrived up to k, y (q,), NaN where missing; nothing moves on."""
        o, steps = self.observer, self._course.steps
        if len(self._course.ahead()) < o.runtime.delay:
            return self.estimate
        given = self._sample(y).y[0]
        nu = np.where(np.isfinite(given), steps.innovation(given), 0.0)
        return self._forward(steps.x + nu @ o.filter_gain.T)

    def step(self, y: ArrayLike | None, u: ArrayLike | None) -> Estimate:
        """Take what arrives and the input at k, return the estimate for k + 1.

        Parameters
        ----------
        y : array_like, shape (q,)
            NaN, or infinite, where a measurement is missing or too old: it corrects nothing at this step. None where
            all are missing.
        u : array_like, shape (m,)
            Not finite where it is not known, or None: the last good value and its change stand for it, zero before the
            first. What is implausible: see `screen`.

        Returns
        -------
        Estimate
            By name, ``estimate["velocity"]``, or as an array, ``np.asarray(estimate)``.

        Raises
        ------
        DimensionError
            When there are not as many measurements or inputs as the observer has.
        DataError
            When they are no numbers.
        """
        course, bank = self._course, self.observer.bank
        sample = self._sample(y, u, course.held)
        if self._fresh:  # it was started at this sample, filter banks without its inputs
            sample = replace(sample, starts=np.full((1, 1), bank is not None))
        self._fresh = False
        run = stepped(course, sample)
        if course.loop is not None:
            course.values[course.loop.name] = course.values[course.loop.name][0]
        self._status = SampleStatus(int(course.bits(sample, run)[0, 0]))
        return self.estimate

    def _sample(self, y: ArrayLike | None, u: ArrayLike | None = None, held: Held | None = None) -> Screened:
        """Return a sample as the observer takes it."""
        y, u = self._shaped(y, "measurements", self.observer.outputs), self._shaped(u, "inputs", self.observer.inputs)
        return self._screen.take(y[None, None], u[None, None], held)

    def _shaped(self, values: ArrayLike | None, what: str, names: Sequence[str]) -> Array:
        values = np.full(len(names), np.nan) if values is None else values
        array = np.array(numbers(self.observer, values, what), ndmin=1)  # a copy: the caller may use its memory again
        if array.shape != (len(names),):
            raise DimensionError(
                f"Running observer {self.observer.name}: expected the {len(names)} {what} {', '.join(names)}, shape "
                f"({len(names)},), found shape {array.shape}."
            )
        return array

    def _forward(self, x: Array) -> Estimate:
        """Predict states, shape (1, n), through the model over the inputs that no measurement has met yet."""
        ahead, steps = self._course.ahead(), self._course.steps
        if len(ahead):
            x = forward(self.observer, steps.values, np.array([len(ahead)]), x, steps.earlier(ahead[0]), ahead)
        recorded = x[0, : len(self.states)].copy()
        self.observer.runtime.clip_estimate(recorded)
        return Estimate(zip(self.states, recorded.tolist(), strict=True))
