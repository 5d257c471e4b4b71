"""An observer with its state, for one machine, sample by sample."""

from __future__ import annotations

from collections import deque
from collections.abc import Iterator, Mapping, MutableMapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import numpy.typing as npt

from ..core.errors import ConfigError, DimensionError
from .data import ObserverData
from .monitor import Watch
from .samples import LONGEST, Held, SampleStatus, Screened
from .screen import Screen
from .step import Steps
from .tracking import PhaseLockedLoop

Array = npt.NDArray[np.float64]


class Estimate(Mapping[str, float]):
    """Estimated states by name; ``np.asarray(estimate)`` has shape (n,).

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

    __slots__ = ("_array", "_places")

    def __init__(self, places: Mapping[str, int], array: Array) -> None:
        self._places, self._array = places, array

    def __getitem__(self, name: str) -> float:
        return float(self._array[self._places[name]])

    def __iter__(self) -> Iterator[str]:
        return iter(self._places)

    def __len__(self) -> int:
        return len(self._places)

    def __array__(self, dtype: Any = None, copy: bool | None = None) -> npt.NDArray[Any]:
        return np.array(self._array, dtype=dtype, copy=copy)

    def __repr__(self) -> str:
        return f"Estimate({', '.join(f'{name}={self[name]:g}' for name in self)})"


class RunningObserver:
    """An observer with its state, for one machine.

    Parameters
    ----------
    observer : ObserverData
    y : ndarray, shape (q,)
        First measurement.
    parameters : mapping of str to float
        The machine's own lifting parameters; they may be changed between steps.

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

    def __init__(self, observer: ObserverData, y: npt.ArrayLike, parameters: Mapping[str, float]) -> None:
        self.observer = observer
        self._screen = Screen.of(observer)
        self._steps, self._ahead = Steps([observer], 1, {}), Steps([observer], 1, {})
        self._places = {name: i for i, name in enumerate(observer.lifting.states)}
        self._measured = tuple(observer.lifting.states[i] for i in observer.measured)
        self._limits = observer.runtime if observer.runtime.binding else None
        self._filter_gain: Array | None = None
        self._unknown = np.ones((1, len(observer.measured)), dtype=bool)
        self._loop: PhaseLockedLoop | None = None
        self._watch = None if observer.monitor is None else Watch(observer.monitor)
        self.parameters = parameters
        self.reset(y)

    @property
    def states(self) -> tuple[str, ...]:
        """Names of the estimated states, in order."""
        return self.observer.lifting.states

    @property
    def parameters(self) -> MutableMapping[str, float]:
        """The machine's lifting parameters; a name that the lifting does not have is refused, and a value that is not finite."""
        return self._parameters

    @parameters.setter
    def parameters(self, values: Mapping[str, float]) -> None:
        """Change all of them."""
        self._parameters = _Checked(self.observer, values)
        self._steps.values = self._ahead.values = self._parameters.plain

    def track(self, name: str, settle_s: float | None = None) -> None:
        """Let one of the parameters follow the machine from now on; see `PhaseLockedLoop`, and `parameters` for its value.

        Raises
        ------
        ConfigError
            When the observer has no such parameter, or has delays.
        """
        self._loop = PhaseLockedLoop(self.observer, name, 1, settle_s)

    @property
    def status(self) -> SampleStatus:
        """What was wrong with the last sample, or with the first measurement before there was one."""
        return self._status

    @property
    def level_db(self) -> float | None:
        """Level of the innovation over the bound of the population in dB; above zero the machine is outside, None without a monitor."""
        return None if self._watch is None else self._watch.level_db

    @property
    def condition(self) -> str | None:
        """Recorded condition that the machine is in, whose bound its innovation is held against; None for that of all conditions.

        Raises
        ------
        ConfigError
            When one is set that the monitor does not know.
        """
        return None if self._watch is None else self._watch.condition

    @condition.setter
    def condition(self, name: str | None) -> None:
        """Change it."""
        if self._watch is not None:
            self._watch.condition = name
        elif name is not None:
            raise ConfigError(
                f"Running observer {self.observer.name}: it has no monitor that would know the condition {name!r}."
            )

    def reset(self, y: npt.ArrayLike) -> None:
        """Start again at a measurement, shape (q,); nothing of the past is left, the parameters stay."""
        first = self._judge(self._measurement(y), np.zeros(len(self.observer.inputs)))
        self._status, self._held = SampleStatus(int(first.status[0, 0])), Held.nothing(1, len(self.observer.inputs))
        self._known: Array | None = None
        self._settling = 0
        self._fresh = bool(np.isfinite(first.y).any())
        if self._watch is not None:
            self._watch.reset()
        self._begin(first.y[0])

    def _begin(self, y: Array, u: Array | None = None) -> None:
        self._steps.begin(y, u=u)
        if self._loop is not None:
            self._loop.begin()
        if self._watch is not None:
            self._watch.begin()
        self._inputs: deque[Array] = deque()

    @property
    def estimate(self) -> Estimate:
        """One-step prediction: the state at k from what arrived up to k - 1."""
        return self._forward(self._steps.x[0, 0])

    def filter(self, y: npt.ArrayLike) -> Estimate:
        """Return the estimate of the state at k from what arrived up to k, y of shape (q,), NaN where a measurement is missing; nothing moves on."""
        o = self.observer
        if len(self._inputs) < o.runtime.delay:
            return self.estimate
        nu = self._steps.innovation(self._judge(self._measurement(y), np.zeros(len(o.inputs))).y[0])[0, 0]
        if self._filter_gain is None:
            self._filter_gain = o.filter_gain
        return self._forward(o.runtime.relifted(self._steps.x[0, 0] + self._filter_gain @ nu))

    def step(self, y: npt.ArrayLike, u: npt.ArrayLike) -> Estimate:
        """Take what arrives and the input at k, return the estimate for k + 1.

        Parameters
        ----------
        y : array_like, shape (q,)
            NaN, or infinite, where a measurement is missing or too old: it corrects nothing at this step.
        u : array_like, shape (m,)
            Not finite where it is not known: the last good value stands for it, zero before the first. What is implausible: see `screen`.

        Returns
        -------
        Estimate
            By name, ``estimate["velocity"]``, or as an array, ``np.asarray(estimate)``.

        Raises
        ------
        DimensionError
            When there are not as many measurements or inputs as the observer has.
        """
        measurement, known = self._take(self._measurement(y), self._input(u))
        self._inputs.append(known)
        if len(self._inputs) > self.observer.runtime.delay:
            taken = self._inputs.popleft()
            if not self._steps.waiting[0, 0]:
                self._advance(measurement, taken)
        if self._steps.waiting[0, 0] or self._settling:
            self._status |= SampleStatus.RESTARTED
            self._settling = max(self._settling - 1, 0)
        if self._steps.waiting[0, 0]:
            held = self._held if self._known is None else Held.good(self._known[None])
            self._held, self._known = replace(held, stale=np.ones(1, dtype=bool)), None
            self._settling = 0 if self.observer.guard is None else self.observer.guard.settle
        if self._watch is not None and self._watch.outside:
            self._status |= SampleStatus.UNCERTIFIED
        return self.estimate

    def _advance(self, measurement: Array, taken: Array) -> None:
        """Take the step of a sample, with the input of its time."""
        steps, absent = self._steps, None
        if self._status and not (there := np.isfinite(measurement)).all():
            absent = ~there
        if self._watch is not None:
            self._watch.take(steps.apart(measurement)[0, 0].tolist(), not self._status)
        if self._loop is None:
            steps.step(measurement, taken, absent)
        else:
            self.parameters[self._loop.name] = float(self._loop.step(steps, measurement, taken, absent)[0])
        if self._limits is not None and not steps.waiting[0, 0] and self._limits.binds(steps.x[0, 0], steps.correction):
            self._status |= SampleStatus.LIMIT

    def _judge(self, y: Array, u: Array, held: Held | None = None) -> Screened:
        return self._screen.take(y[None, None], u[None, None], held)

    def _take(self, y: Array, u: Array) -> tuple[Array, Array]:
        """Judge a sample, and start again where that is due; the first sample is the one that the observer started at."""
        before, self._known = self._known, None
        if before is not None:
            status = self._screen.at_once(y.tolist(), u.tolist())
            if status is not None:
                self._known, self._status = u, status
                return y[None], u[None]
            self._held = Held.good(before[None])
        samples = self._judge(y, u, self._held)
        self._status, self._held = SampleStatus(int(samples.status[0, 0])), samples.held
        first, self._fresh = self._fresh, False
        if first and not (samples.held.since > LONGEST).any():
            self._held = replace(samples.held, stale=np.zeros(1, dtype=bool))
            if self.observer.bank is not None and samples.starts[0, 0]:
                self._begin(samples.y[0], samples.u[0])
        elif samples.starts[0, 0]:
            self._begin(samples.y[0], samples.u[0])
        if not (self._held.stale[0] or self._held.since.any()):
            self._known = samples.u[0, 0]
        return samples.y[0], samples.u[0]

    def _measurement(self, y: npt.ArrayLike) -> Array:
        return self._shaped(y, "measurements", self._measured)

    def _input(self, u: npt.ArrayLike) -> Array:
        return self._shaped(u, "inputs", self.observer.inputs)

    def _shaped(self, values: npt.ArrayLike, what: str, names: Sequence[str]) -> Array:
        array = np.array(values, dtype=float, ndmin=1)  # a copy: the caller may use its memory again
        if array.shape != (len(names),):
            raise DimensionError(
                f"Running observer {self.observer.name}: expected the {len(names)} {what} {', '.join(names)}, shape ({len(names)},), "
                f"found shape {array.shape}."
            )
        return array

    def _forward(self, x: Array) -> Estimate:
        """Predict through the model over the inputs that no measurement has met yet."""
        if not self._inputs:
            return self._given(x)
        ahead = self._ahead
        ahead.place(x[None], self._steps.earlier(self._inputs[0])[0])
        for u in self._inputs:
            ahead.step(np.zeros(self._unknown.shape), u, self._unknown)
        return self._given(ahead.x[0, 0])

    def _given(self, x: Array) -> Estimate:
        return Estimate(self._places, x.copy() if self._limits is None else self._limits.clip_estimate(x.copy()))


class _Checked(MutableMapping[str, float]):
    """Parameters of one machine; what the lifting does not know, or cannot use, does not get in. `plain` holds what did."""

    def __init__(self, observer: ObserverData, values: Mapping[str, float]) -> None:
        self._observer = observer
        self.plain = observer.values(values, ())

    def __getitem__(self, name: str) -> float:
        return float(self.plain[name])

    def __setitem__(self, name: str, value: float) -> None:
        self.plain.update(self._observer.values({**self.plain, name: value}, ()))

    def __delitem__(self, name: str) -> None:
        raise ConfigError(
            f"Running observer {self._observer.name}: the parameter {name!r} cannot be taken away; change its value."
        )

    def __iter__(self) -> Iterator[str]:
        return iter(self.plain)

    def __len__(self) -> int:
        return len(self.plain)
