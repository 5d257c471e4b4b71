"""The observer as deployed (18)-(21): retracted and re-lifted at every step.

      u ──►┌──────────────────────────┐
           │ x_hat+ = A theta(x_hat)  │──► x_hat ──► C ──► y_hat
     y^c──►│          + B u + y^c     │                      │ -
           └──────────────────────────┘                      ▼
           K: x^c+ = A^c x^c + B^c nu  ◄── nu = y - y_hat ──(+)◄── y
              y^c  = C^c x^c + D^c nu

The correction enters through the state as drawn, or through the input, ``B (u + y^c)``, as in the paper. The observer is a
one-step predictor: the estimate for k + 1 uses data up to k. Where the lifting has delays, theta reads earlier estimates and inputs too;
before the start these are taken to equal the first ones. Where it has input functions, u stands for the lifted inputs.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import numpy.typing as npt

from ..core.artifacts import plain, read_json, write_json
from ..core.errors import DataError, DimensionError
from ..core.lti import StateSpace, gain
from ..lifting import Lifting
from ..synthesis.result import Injection
from .simulate import run_observer

Array = npt.NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Observer:
    """Nominal lifted model with a correction.

    Parameters
    ----------
    name : str
    lifting : Lifting
    A : ndarray, shape (n_lifted, n_lifted)
    B : ndarray, shape (n_lifted, m)
        With input functions, m counts them.
    measured : tuple of int
        Indices of the measured states.
    inputs : tuple of str
        Recorded inputs.
    controller : StateSpace
        From innovation (q) to correction: (m) for input injection, (n_lifted) for state injection.
    injection : Injection
    sample_period_s : float
    parameters : mapping of str to float
        Default values of the lifting's parameters, the nominal unit's.
    """

    name: str
    lifting: Lifting
    A: Array
    B: Array
    measured: tuple[int, ...]
    inputs: tuple[str, ...]
    controller: StateSpace
    injection: Injection
    sample_period_s: float
    parameters: Mapping[str, float] = field(default_factory=dict)

    def __post_init__(self) -> None:
        if self.B.shape[1] != len(self.inputs) + len(self.lifting.input_functions):
            raise DimensionError(
                f"Observer {self.name}: {len(self.inputs)} inputs {self.inputs} and {len(self.lifting.input_functions)} functions of them need as many "
                f"columns of B, found {self.B.shape[1]}."
            )
        width = self.B.shape[1] if self.injection is Injection.INPUT else self.A.shape[0]
        K = self.controller
        if (K.n_inputs, K.n_outputs) != (len(self.measured), width):
            raise DimensionError(
                f"Observer {self.name}: the controller should map {len(self.measured)} innovations to {width} corrections ({self.injection.value} injection), "
                f"found {K.n_inputs} to {K.n_outputs}."
            )

    @classmethod
    def open_loop(
        cls, name: str, lifting: Lifting, A: Array, B: Array, measured: tuple[int, ...], inputs: tuple[str, ...], sample_period_s: float
    ) -> Observer:
        """Return the nominal model without any correction."""
        controller = gain(np.zeros((len(A), len(measured))), sample_period_s)
        return cls(name, lifting, A, B, measured, inputs, controller, Injection.STATE, sample_period_s)

    @property
    def one_step(self) -> Array:
        """The map from [theta, x^c, u, y] to [x_hat+, x^c+], shape (n + n_c, n_lifted + n_c + m + q)."""
        K, n = self.controller, self.lifting.n_states
        C = np.eye(self.A.shape[0])[list(self.measured)]
        into = self.B if self.injection is Injection.INPUT else np.eye(self.A.shape[0])
        plant = np.hstack([self.A - into @ K.D @ C, into @ K.C, self.B, into @ K.D])[:n]
        controller = np.hstack([-K.B @ C, K.A, np.zeros((K.n_states, self.B.shape[1])), K.B])
        return np.vstack([plant, controller])

    def initial(self, y: npt.ArrayLike) -> Array:
        """Return the first estimate: the first measurement, other states zero; shape (..., n)."""
        y = np.asarray(y, dtype=float)
        x = np.zeros((*y.shape[:-1], self.lifting.n_states))
        x[..., list(self.measured)] = y
        return x

    def start(self, y: npt.ArrayLike, parameters: Mapping[str, float] | None = None) -> RunningObserver:
        """Return a running observer that starts at a first measurement, shape (q,)."""
        return RunningObserver(self, np.atleast_1d(np.asarray(y, dtype=float)), {**self.parameters, **(parameters or {})})

    def run(self, y: Array, u: Array, parameters: Mapping[str, npt.ArrayLike] | None = None) -> Array:
        """Estimate a batch of episodes; see `run_observer`."""
        return run_observer(self, y, u, parameters)

    def save(self, path: Path) -> None:
        """Write the observer as one JSON file that a person can read."""
        content = {
            "schema": 1,
            "kind": "observer",
            "name": self.name,
            "states": self.lifting.states,
            "lifting": self.lifting.functions,
            **self.lifting.extension(),
            "parameters": {k: self.parameters.get(k) for k in self.lifting.parameters},
            "inputs": self.inputs,
            "measured": self.measured,
            "injection": self.injection,
            "sample_period_s": self.sample_period_s,
            "model": {"A": self.A, "B": self.B},
            "controller": {key: getattr(self.controller, key) for key in "ABCD"},
        }
        write_json(path, plain(content))

    @classmethod
    def load(cls, path: Path) -> Observer:
        """Read what `save` wrote."""
        content = read_json(path)
        if not isinstance(content, dict) or (content.get("schema"), content.get("kind")) != (1, "observer"):
            raise DataError(f"Loading an observer from {path}: not an observer file of schema 1; write it again with this version of kros.")
        lifting = Lifting.from_content(content)
        n, m, q = lifting.n_lifted, len(content["inputs"]) + len(lifting.input_functions), len(content["measured"])
        injection, dt = Injection(content["injection"]), content["sample_period_s"]
        width = m if injection is Injection.INPUT else n
        raw = {key: np.asarray(value, dtype=float) for key, value in content["controller"].items()}
        order = raw["A"].shape[0]
        controller = StateSpace(
            raw["A"].reshape(order, order), raw["B"].reshape(order, q), raw["C"].reshape(width, order), raw["D"].reshape(width, q), dt
        )
        model = {key: np.asarray(value, dtype=float) for key, value in content["model"].items()}
        defaults = {k: v for k, v in content["parameters"].items() if v is not None}
        return cls(
            content["name"],
            lifting,
            model["A"],
            model["B"],
            tuple(content["measured"]),
            tuple(content["inputs"]),
            controller,
            injection,
            dt,
            defaults,
        )


class RunningObserver:
    """An observer with its state, for one machine.

    Parameters
    ----------
    observer : Observer
    y : ndarray, shape (q,)
        First measurement.
    parameters : mapping of str to float
        The machine's own lifting parameters.
    """

    def __init__(self, observer: Observer, y: Array, parameters: Mapping[str, float]) -> None:
        self.observer = observer
        self.parameters = dict(parameters)
        self._map = observer.one_step
        self.reset(y)

    @property
    def estimate(self) -> Array:
        """Estimate of the states, shape (n,)."""
        return self._state[: self.observer.lifting.n_states].copy()

    def reset(self, y: npt.ArrayLike) -> None:
        """Start again at a measurement, shape (q,)."""
        self._earlier: Array | None = None
        self._state = np.concatenate(
            [self.observer.initial(np.atleast_1d(np.asarray(y, dtype=float))), np.zeros(self.observer.controller.n_states)]
        )

    def step(self, y: npt.ArrayLike, u: npt.ArrayLike) -> Array:
        """Take the measurement and input at k, return the estimate for k + 1.

        Parameters
        ----------
        y : array_like, shape (q,)
        u : array_like, shape (m,)

        Returns
        -------
        ndarray, shape (n,)
        """
        lifting = self.observer.lifting
        n, u = lifting.n_states, np.atleast_1d(np.asarray(u, dtype=float))
        if self._earlier is None:
            self._earlier = lifting.window.hold(self._state[:n], u)
        window = np.concatenate([self._state[:n], self._earlier])
        theta, lifted_u = lifting.lift(window, self.parameters), lifting.lift_inputs(u, window, self.parameters)
        self._state = self._map @ np.concatenate([theta, self._state[n:], lifted_u, np.atleast_1d(y)])
        self._earlier = lifting.window.advance(window, u)
        return self.estimate
