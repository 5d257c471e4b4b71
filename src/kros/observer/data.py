"""The observer as data: nominal lifted model, correction, delay and limits (18)-(21).

      u ──►┌──────────────────────────┐
           │ x_hat+ = A theta(x_hat)  │──► x_hat ──► C ──► y_hat
     y^c──►│          + B u + y^c     │                      │ -
           └──────────────────────────┘                      ▼
           K: x^c+ = A^c x^c + B^c nu  ◄── nu = y - y_hat ──(+)◄── y
              y^c  = C^c x^c + D^c nu

The correction enters through the state as drawn, or through the input, ``B (u + y^c)``, as in the paper. The observer
is a one-step predictor: the estimate for k + 1 uses data up to k. Where the lifting has delays, theta reads earlier
estimates and inputs too; before the start these are taken to equal the first ones. Where it has input functions, u
stands for the lifted inputs.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import field
from functools import cached_property
from typing import Any

import numpy as np

from ..core import (
    ITERATED,
    Array,
    ArrayLike,
    ByName,
    Columns,
    ConfigError,
    DimensionError,
    Names,
    Parameters,
    Record,
    StateSpace,
    frozen,
    member,
)
from ..core.linalg import balanced_size
from ..lifting import Lifting
from ..synthesis.result import Injection
from .filter_bank import FilterBank
from .monitor import Monitor
from .runtime import Guard, Runtime, Seen
from .sensor import Sensors, require_measured


@frozen
class ObserverData:
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
        Largest sizes of measurements and inputs in training; larger samples are implausible (see `screen`); none
        by default.
    sensor : mapping of str to Sensor
        Declared sensors of measured states, by name. What arrives late is corrected by `runtime`.
    monitor : Monitor, optional
        Watches the innovation for machines that are outside the population's envelope; nothing by default.
    bank : FilterBank, optional
        Of an observer that is a filter bank: measurements stand in its model in place of their estimates, and the
        correction is zero.
    guard : Guard, optional
        Bounds of its states, outside which it starts again; by default where one is not finite.
    about : mapping of str to JSON values
        What people should know of it: units of measure, ranges, certificates. It is part of the file; nothing computes
        with it.

    Raises
    ------
    DimensionError
        When sizes do not fit, or a filter bank has a correction.
    ConfigError
        When a sensor is that of a state that is not measured.
    """

    name: str
    lifting: Lifting
    A: Array
    B: Array
    measured: Columns
    inputs: Names
    controller: StateSpace
    injection: Injection
    sample_period_s: float
    parameters: Mapping[str, float] = field(default_factory=dict)
    runtime: Runtime = field(default_factory=Runtime)
    seen: Seen | None = None
    sensor: Sensors = field(default_factory=dict)
    monitor: Monitor | None = None
    bank: FilterBank | None = None
    guard: Guard | None = None
    about: ByName = field(default_factory=dict)

    def __post_init__(self) -> None:
        object.__setattr__(self, "injection", member(Injection, self.injection, f"Observer {self.name}: the injection"))
        K, n, q, m = self.controller, self.lifting.n_states, len(self.measured), len(self.inputs)
        rows, columns = self.lifting.n_lifted, m + len(self.lifting.input_functions)
        width = columns if self.injection is Injection.INPUT else rows
        self._require("the model A", self.A.shape, (rows, rows))
        self._require(f"the model B, of {m} inputs and {columns - m} functions of them,", self.B.shape, (rows, columns))
        of_controller = (
            f"the controller, from {q} innovations to {width} corrections of {self.injection.value} injection,"
        )
        self._require(of_controller, K.D.shape, (width, q))
        for key, values in self.runtime.by_state().items():
            self._require(f"runtime.{key}", values.shape, (n,))
        if self.seen is not None:
            self._require("sizes seen in training", (self.seen.measured.shape, self.seen.inputs.shape), ((q,), (m,)))
        if self.monitor is not None:
            self._require("the monitor", self.monitor.size.shape, (q,))
        require_measured(self.sensor, self.outputs)
        if self.bank is not None:
            bank, recorded = self.bank, (len(self.recorded),)
            shapes = tuple(getattr(bank, key).shape for key in ("start", "half", "recovery", "doubt", "persistence"))
            wanted = (n, rows + columns), recorded, (1,), (bank.filters,) * 2, (m,)
            self._require("start, half, recovery, doubt and persistence", shapes, wanted)
            names = ("reach", "noise", "rest", "gate", "opening", "deviations")
            of_measurements = tuple(getattr(bank, key).shape for key in names)
            self._require(", ".join(names), of_measurements, ((q,),) * len(names))
            if not 0 <= bank.filters <= (most := n - 3 * recorded[0]) or K.D.any() or K.n_states:
                raise DimensionError(
                    f"Observer {self.name}: a filter bank has no correction, and of its states at most {most} filters "
                    f"of measurements; found a correction of order {K.n_states} and {bank.filters} filters."
                )
        if self.guard is not None:
            sizes = self.guard.lower.shape, self.guard.upper.shape, self.guard.correction.shape
            self._require("the guard of states and correction", sizes, ((n,), (n,), (K.n_states,)))

    def _require(self, what: str, shape: tuple[Any, ...], wanted: tuple[Any, ...]) -> None:
        if shape != wanted:
            raise DimensionError(f"Observer {self.name}: {what} should have shape {wanted}, found {shape}.")

    def __repr__(self) -> str:
        """Say what kind of observer it is, in a line."""
        states, own = ", ".join(self.recorded), f" + {self.internal} internal" if self.internal else ""
        functions = f", {len(self.lifting.functions)} lifted functions" if self.lifting.functions else ""
        y = ", ".join(self.outputs)
        correction = f"correction of order {self.controller.n_states}, {self.sample_period_s:g} s"
        return f"<Observer {self.name}: {states}{own}{functions} from {y}; {correction}>"

    @property
    def outputs(self) -> list[str]:
        """Names of the measured states."""
        return [self.lifting.states[i] for i in self.measured]

    @property
    def internal(self) -> int:
        """Number of states at the end that recordings do not hold: those of a filter bank."""
        return 0 if self.bank is None else self.lifting.n_states - self.bank.half.shape[-1]

    @property
    def into(self) -> Array:
        """Where the correction enters, shape (n_lifted, width)."""
        return self.B if self.injection is Injection.INPUT else np.eye(self.A.shape[0])

    @cached_property
    def filter_gain(self) -> Array:
        """Gain L_f of ``x_hat + L_f (y - C x_hat)``, (n, q): ``A_s L_f = (into D^c)_s`` by least squares."""
        n = self.lifting.n_states
        if self.bank is not None:
            return np.eye(n)[:, list(self.measured)]
        A, size = self.A[:n, :n], balanced_size(self.A[:n, :n])[:, None]
        values = (self.into @ self.controller.D)[:n] / size
        return np.linalg.lstsq(A * size.T / size, values, rcond=ITERATED)[0] * size

    @property
    def one_step(self) -> Array:
        """The map from [theta, x^c, u, y] to [x_hat+, x^c+], shape (n + n_c, n_lifted + n_c + m + q)."""
        K, n, into = self.controller, self.lifting.n_states, self.into
        C = np.eye(self.A.shape[0])[list(self.measured)]
        plant = np.hstack([self.A - into @ K.D @ C, into @ K.C, self.B, into @ K.D])[:n]
        controller = np.hstack([-K.B @ C, K.A, np.zeros((K.n_states, self.B.shape[1])), K.B])
        return np.vstack([plant, controller])

    @property
    def recorded(self) -> Names:
        """States that recordings hold: all but the internal ones."""
        return self.lifting.states[: self.lifting.n_states - self.internal]

    def initial(self, y: ArrayLike, parameters: Parameters | None = None, u: ArrayLike | None = None) -> Array:
        """Return the first estimate, (..., n): measurements, and others as `runtime.first` or as a bank starts."""
        y, at = np.asarray(y, dtype=float), list(self.measured)
        x = np.tile(self.runtime.first(self.lifting.n_states), (*y.shape[:-1], 1))
        x[..., at] = np.where(np.isfinite(y), y, x[..., at])
        if self.bank is not None:
            inputs = np.broadcast_to(0.0 if u is None else u, (*y.shape[:-1], len(self.inputs)))
            values = self.values(parameters)
            lifted = [self.lifting.lift(x, values), self.lifting.lift_inputs(inputs, x, values)]
            x = np.concatenate(lifted, axis=-1) @ self.bank.start.T
        return x

    def own(self, parameters: Parameters) -> dict[str, ArrayLike]:
        """Return those parameters of many that the lifting has."""
        return {name: parameters[name] for name in self.lifting.parameters if name in parameters}

    def values(self, parameters: Parameters | None = None, shape: tuple[int, ...] | None = None) -> Record:
        """Return the lifting's parameters, the observer's own where none is given; each broadcasts to `shape`."""
        known, values = self.lifting.parameters, {**self.parameters, **(parameters or {})}
        given = {name: np.asarray(values[name], dtype=float) for name in known if values.get(name) is not None}
        problems = {
            "unknown": [name for name in values if name not in known and name not in self.parameters],
            "missing": [name for name in known if name not in given],
            "not finite": [name for name, value in given.items() if not np.isfinite(value).all()],
        }
        for what, names in problems.items():
            if names:
                raise ConfigError(
                    f"Running observer {self.name}: the parameter {', '.join(map(repr, names))} is {what}; its lifting "
                    f"has {', '.join(known) or 'no parameters'}."
                )
        for name, value in given.items() if shape is not None else ():
            if (found := value.shape) not in ((), shape, (1,) * len(shape or ())):
                raise DimensionError(
                    f"Running observer {self.name}: {name!r} should have shape {shape}, found {found}."
                )
        return values
