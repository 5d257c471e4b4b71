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
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from ..core.artifacts import plain, read_json, write_json
from ..core.errors import ConfigError, DataError, DimensionError
from ..core.lti import StateSpace, gain
from ..lifting import Lifting
from ..synthesis.result import Injection
from .runtime import Runtime
from .screen import Seen
from .simulate import run_observer

if TYPE_CHECKING:
    from .running import RunningObserver

Array = npt.NDArray[np.float64]


def memory_names(count: int) -> tuple[str, ...]:
    """Names of an observer's states that nothing is recorded for."""
    return tuple(f"memory_{i + 1}" for i in range(count))


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
    runtime : Runtime
        Delay of the measurement, limits, and the gain of filtered estimates.
    seen : Seen, optional
        Largest sizes of measurements and inputs in training, beyond which samples are implausible (see `screen`); none by default.
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
    runtime: Runtime = field(default_factory=Runtime)
    seen: Seen | None = None

    def __post_init__(self) -> None:
        object.__setattr__(self, "injection", Injection(self.injection))
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
        self.runtime.require_fit(self.name, self.lifting.n_states, len(self.measured), width, len(self.inputs))
        if self.seen is not None and (len(self.seen.measured), len(self.seen.inputs)) != (len(self.measured), len(self.inputs)):
            raise DimensionError(
                f"Observer {self.name}: {len(self.measured)} measurements and {len(self.inputs)} inputs need as many sizes seen in training, found "
                f"{len(self.seen.measured)} and {len(self.seen.inputs)}."
            )

    @classmethod
    def open_loop(
        cls, name: str, lifting: Lifting, A: Array, B: Array, measured: tuple[int, ...], inputs: tuple[str, ...], sample_period_s: float
    ) -> Observer:
        """Return the nominal model without any correction."""
        controller = gain(np.zeros((len(A), len(measured))), sample_period_s)
        return cls(name, lifting, A, B, measured, inputs, controller, Injection.STATE, sample_period_s)

    @property
    def into(self) -> Array:
        """Where the correction enters, shape (n_lifted, width)."""
        return self.B if self.injection is Injection.INPUT else np.eye(self.A.shape[0])

    @property
    def filter_gain(self) -> Array:
        """Gain from the innovation to the filtered estimate, ``x_hat(k|k) = x_hat(k) + L_f (y - C x_hat(k))``; shape (n, q).

        As declared in `runtime`; else what the correction says of it. The direct correction of the next estimate is that of this one, carried
        through the model: ``A_s L_f = (into D^c)_s`` by least squares. For a Kalman predictor of a linear model this is its filter, exactly;
        memory of the correction and slopes of lifted functions are left out.
        """
        if self.runtime.filter_gain is not None:
            return self.runtime.filter_gain
        n = self.lifting.n_states
        return np.asarray(np.linalg.lstsq(self.A[:n, :n], (self.into @ self.controller.D)[:n], rcond=1e-9)[0])

    @property
    def one_step(self) -> Array:
        """The map from [theta, x^c, u, y] to [x_hat+, x^c+], shape (n + n_c, n_lifted + n_c + m + q)."""
        K, n, into = self.controller, self.lifting.n_states, self.into
        C = np.eye(self.A.shape[0])[list(self.measured)]
        plant = np.hstack([self.A - into @ K.D @ C, into @ K.C, self.B, into @ K.D])[:n]
        controller = np.hstack([-K.B @ C, K.A, np.zeros((K.n_states, self.B.shape[1])), K.B])
        return np.vstack([plant, controller])

    @property
    def replaces(self) -> bool:
        """Whether measurements take the place of the estimates of measured states: a gain alone, equal to these states' columns of A."""
        return self.controller.n_states == 0 and np.array_equal(self.A[:, list(self.measured)], self.into @ self.controller.D)

    @property
    def recorded(self) -> tuple[str, ...]:
        """States that recordings hold: all but those of a memory, ``memory_1, ...`` at the end."""
        states = self.lifting.states
        first = next((i for i in range(len(states)) if states[i:] == memory_names(len(states) - i)), len(states))
        return states[:first]

    def initial(self, y: npt.ArrayLike, parameters: Mapping[str, npt.ArrayLike] | None = None) -> Array:
        """Return the first estimate: the first measurement where there is one, other states zero; shape (..., n).

        Where measurements take the place of estimates, other states start at rest: where the lifted functions alone hold them, inputs
        and measurements in balance.
        """
        y = np.asarray(y, dtype=float)
        y = np.where(np.isfinite(y), y, 0.0)
        n = self.lifting.n_states
        x = np.zeros((*y.shape[:-1], n))
        x[..., list(self.measured)] = y
        if self.replaces and self.lifting.functions and not self.lifting.history:
            others = [i for i in range(n) if i not in self.measured]
            held = self.lifting.lift(x, {**self.parameters, **(parameters or {})})[..., n:] @ self.A[others, n:].T
            x[..., others] = np.linalg.lstsq(np.eye(len(others)) - self.A[np.ix_(others, others)], held.reshape(-1, len(others)).T)[
                0
            ].T.reshape(held.shape)
        return x

    def start(self, y: npt.ArrayLike, parameters: Mapping[str, float] | None = None) -> RunningObserver:
        """Return a running observer that starts at a first measurement, shape (q,).

        Raises
        ------
        ConfigError
            When a parameter is unknown, missing or not finite.
        DimensionError
            When there are not as many measurements as the observer has.
        """
        from .running import RunningObserver

        return RunningObserver(self, y, {**self.parameters, **(parameters or {})})

    def values(self, parameters: Mapping[str, npt.ArrayLike] | None = None, shape: tuple[int, ...] | None = None) -> dict[str, Any]:
        """Return the lifting's parameters: those that are given, the observer's own for the others.

        Parameters
        ----------
        parameters : mapping of str to array_like
        shape : tuple of int, optional
            What every value has to broadcast to.

        Raises
        ------
        ConfigError
            When one is unknown, missing or not finite.
        DimensionError
            When one has another shape.
        """
        known, values = self.lifting.parameters, {**self.parameters, **(parameters or {})}
        unknown = [name for name in values if name not in known and name not in self.parameters]
        missing = [name for name in known if values.get(name) is None]
        wrong = [name for name in known if name not in missing and not np.isfinite(np.asarray(values[name], dtype=float)).all()]
        for names, what in ((unknown, "unknown"), (missing, "missing"), (wrong, "not finite")):
            if names:
                raise ConfigError(
                    f"Running observer {self.name}: the parameter {', '.join(map(repr, names))} is {what}; its lifting has "
                    f"{', '.join(known) or 'no parameters'}."
                )
        for name in known if shape is not None else ():
            found = np.shape(values[name])
            if found not in ((), shape, (1,) * len(shape or ())):
                raise DimensionError(f"Running observer {self.name}: the parameter {name!r} should have shape {shape}, found {found}.")
        return values

    def run(self, y: Array, u: Array, parameters: Mapping[str, npt.ArrayLike] | None = None) -> Array:
        """Estimate a batch of episodes; see `run_observer`."""
        return run_observer(self, y, u, parameters)

    def save(self, path: Path | str) -> None:
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
            **self.runtime.content(),
        }
        if self.seen is not None:
            content["seen"] = {"measured": self.seen.measured, "inputs": self.seen.inputs}
        write_json(Path(path), plain(content))

    @classmethod
    def load(cls, path: Path | str) -> Observer:
        """Read what `save` wrote."""
        content = read_json(Path(path))
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
            Runtime.from_content(content),
            Seen.from_content(content.get("seen")),
        )
