"""An observer with its state, for one machine, sample by sample."""

from __future__ import annotations

from collections import deque
from collections.abc import Mapping

import numpy as np
import numpy.typing as npt

from .careful import innovation, next_estimate
from .observer import Observer

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

    def __init__(self, observer: Observer, y: Array, parameters: Mapping[str, float]) -> None:
        self.observer = observer
        self.parameters = dict(parameters)
        self.reset(y)

    def reset(self, y: npt.ArrayLike) -> None:
        """Start again at a measurement, shape (q,)."""
        self._x = self.observer.initial(np.atleast_1d(np.asarray(y, dtype=float)), self.parameters)
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
        nu = innovation(o, self._x, np.atleast_1d(np.asarray(y, dtype=float)))
        return self._forward(o.runtime.clip_estimate(self._x + o.filter_gain @ nu))

    def step(self, y: npt.ArrayLike, u: npt.ArrayLike) -> Array:
        """Take what arrives and the input at k, return the estimate for k + 1.

        Parameters
        ----------
        y : array_like, shape (q,)
            NaN, or infinite, where a measurement is missing or too late: it corrects nothing at this step.
        u : array_like, shape (m,)

        Returns
        -------
        ndarray, shape (n,)
        """
        o, K = self.observer, self.observer.controller
        self._inputs.append(np.atleast_1d(np.asarray(u, dtype=float)))
        if len(self._inputs) > o.runtime.delay:
            held = self._inputs.popleft()
            nu = innovation(o, self._x, np.atleast_1d(np.asarray(y, dtype=float)))
            window = np.concatenate([self._x, self._before(held)])
            self._x = next_estimate(o, window, held, K.C @ self._x_c + K.D @ nu, self.parameters)
            self._x_c = K.A @ self._x_c + K.B @ nu
            self._earlier = o.lifting.window.advance(window, held)
        return self.estimate

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
