"""An observer with its state, for one machine, sample by sample."""

from __future__ import annotations

from collections import deque
from collections.abc import Iterator, Mapping, MutableMapping, Sequence
from dataclasses import replace

import numpy as np
import numpy.typing as npt

from ..core.errors import ConfigError, DimensionError
from .careful import innovation, next_estimate
from .observer import Observer
from .screen import LONGEST, Held, SampleStatus, Screen

Array = npt.NDArray[np.float64]


class RunningObserver:
    """An observer with its state, for one machine.

    Parameters
    ----------
    observer : Observer
    y : ndarray, shape (q,)
        First measurement.
    parameters : mapping of str to float
        The machine's own lifting parameters; they may be changed between steps.
    """

    def __init__(self, observer: Observer, y: npt.ArrayLike, parameters: Mapping[str, float]) -> None:
        self.observer = observer
        self.parameters = parameters
        self._screen = Screen.of(observer)
        self.reset(y)

    @property
    def parameters(self) -> MutableMapping[str, float]:
        """The machine's lifting parameters; a name that the lifting does not have is refused, and a value that is not finite."""
        return self._parameters

    @parameters.setter
    def parameters(self, values: Mapping[str, float]) -> None:
        """Change all of them."""
        self._parameters = _Checked(self.observer, values)

    @property
    def status(self) -> SampleStatus:
        """What was wrong with the last sample, or with the first measurement before there was one."""
        return self._status

    def reset(self, y: npt.ArrayLike) -> None:
        """Start again at a measurement, shape (q,); nothing of the past is left, the parameters stay."""
        m = len(self.observer.inputs)
        first = self._screen.take(self._measurement(y)[None, None], np.zeros((1, 1, m)))
        self._status, self._held = SampleStatus(int(first.status[0, 0])), Held.nothing(1, m)
        self._fresh = bool(np.isfinite(first.y).any())
        self._begin(first.y[0, 0])

    def _begin(self, y: Array) -> None:
        self._x = self.observer.initial(y, self.parameters)
        self._x_c = np.zeros(self.observer.controller.n_states)
        self._earlier: Array | None = None
        self._inputs: deque[Array] = deque()

    @property
    def estimate(self) -> Array:
        """One-step prediction: the state at k from what arrived up to k - 1, shape (n,)."""
        return self._forward(self._x)

    def filter(self, y: npt.ArrayLike) -> Array:
        """Return the estimate of the state at k from what arrived up to k, shape (n,); nothing moves on.

        Parameters
        ----------
        y : array_like, shape (q,)
            What arrives at k; NaN where a measurement is missing.
        """
        o = self.observer
        if len(self._inputs) < o.runtime.delay:
            return self.estimate
        taken = self._screen.take(self._measurement(y)[None, None], np.zeros((1, 1, len(o.inputs)))).y[0, 0]
        nu = innovation(o, self._x, taken)
        return self._forward(o.runtime.clip_estimate(self._x + o.filter_gain @ nu))

    def step(self, y: npt.ArrayLike, u: npt.ArrayLike) -> Array:
        """Take what arrives and the input at k, return the estimate for k + 1.

        Parameters
        ----------
        y : array_like, shape (q,)
            NaN, or infinite, where a measurement is missing or too late: it corrects nothing at this step.
        u : array_like, shape (m,)
            Not finite where it is not known: the last good value stands for it, zero before the first. What is implausible: see `screen`.

        Returns
        -------
        ndarray, shape (n,)

        Raises
        ------
        DimensionError
            When there are not as many measurements or inputs as the observer has.
        """
        o, K = self.observer, self.observer.controller
        y, u = self._take(self._measurement(y), self._input(u))
        self._inputs.append(u)
        if len(self._inputs) > o.runtime.delay:
            held = self._inputs.popleft()
            nu = innovation(o, self._x, y)
            window, correction = np.concatenate([self._x, self._before(held)]), K.C @ self._x_c + K.D @ nu
            self._x = next_estimate(o, window, held, correction, self.parameters)
            self._x_c = K.A @ self._x_c + K.B @ nu
            self._earlier = o.lifting.window.advance(window, held)
            if o.runtime.binds(self._x, correction):
                self._status |= SampleStatus.LIMIT
        return self.estimate

    def _take(self, y: Array, u: Array) -> tuple[Array, Array]:
        """Judge a sample, and start anew where that is due; the first sample is the one that the observer started at."""
        samples = self._screen.take(y[None, None], u[None, None], self._held)
        self._status, self._held = SampleStatus(int(samples.status[0, 0])), samples.held
        y, first = samples.y[0, 0], self._fresh
        self._fresh = False
        if first and not (samples.held.since > LONGEST).any():
            self._held = replace(samples.held, stale=np.zeros(1, dtype=bool))
        elif samples.starts[0, 0]:
            self._begin(y)
        return y, samples.u[0, 0]

    def _measurement(self, y: npt.ArrayLike) -> Array:
        return self._shaped(
            y, len(self.observer.measured), "measurements", [self.observer.lifting.states[i] for i in self.observer.measured]
        )

    def _input(self, u: npt.ArrayLike) -> Array:
        return self._shaped(u, len(self.observer.inputs), "inputs", self.observer.inputs)

    def _shaped(self, values: npt.ArrayLike, count: int, what: str, names: Sequence[str]) -> Array:
        array = np.atleast_1d(np.asarray(values, dtype=float))
        if array.shape != (count,):
            raise DimensionError(
                f"Running observer {self.observer.name}: expected the {count} {what} {', '.join(names)}, shape ({count},), found shape {array.shape}."
            )
        return array

    def _before(self, u: Array) -> Array:
        """Earlier values; at the start they equal the present ones."""
        return self.observer.lifting.window.hold(self._x, u) if self._earlier is None else self._earlier

    def _forward(self, x: Array) -> Array:
        """Predict through the model over the inputs that no measurement has met yet."""
        if self._inputs:
            earlier, nothing = self._before(self._inputs[0]), np.zeros(self.observer.controller.n_outputs)
        for u in self._inputs:
            window = np.concatenate([x, earlier])
            x, earlier = next_estimate(self.observer, window, u, nothing, self.parameters), self.observer.lifting.window.advance(window, u)
        return x.copy()


class _Checked(MutableMapping[str, float]):
    """Parameters of one machine; what the lifting does not know, or cannot use, does not get in."""

    def __init__(self, observer: Observer, values: Mapping[str, float]) -> None:
        self._observer = observer
        self._values = observer.values(values, ())

    def __getitem__(self, name: str) -> float:
        return float(self._values[name])

    def __setitem__(self, name: str, value: float) -> None:
        self._values = self._observer.values({**self._values, name: value}, ())

    def __delitem__(self, name: str) -> None:
        raise ConfigError(f"Running observer {self._observer.name}: the parameter {name!r} cannot be taken away; change its value.")

    def __iter__(self) -> Iterator[str]:
        return iter(self._values)

    def __len__(self) -> int:
        return len(self._values)
