r"""A controller that uses estimates, as people give it: matrices and names of signals."""

from __future__ import annotations

from dataclasses import replace
from typing import Any, Self

import numpy as np
from pydantic import Field

from kros.core.errors import ConfigError
from kros.core.files import did_you_mean
from kros.core.lti import StateSpace, gain, real_array
from kros.core.rounding import AGREED
from kros.core.settings import Settings
from kros.identify import ModelSet
from kros.observer.data import ObserverData
from kros.observer.units import recorded_factors

Rows = tuple[tuple[float, ...], ...]


class Controller(Settings):
    """A discrete controller from estimates to inputs of the plant, by name, in the units of the recordings.

    Its output is added to the command, ``u = r + K x_hat``: one that opposes has the minus sign in it. Matrices are
    rows of numbers; `limits` are those of the plant's inputs, where actuators have some.

    """

    A: Rows = ()
    B: Rows = ()
    C: Rows = ()
    D: Rows
    sample_period_s: float
    inputs: tuple[str, ...]
    outputs: tuple[str, ...]
    limits: dict[str, tuple[float, float]] = Field(default_factory=dict)

    @property
    def system(self) -> StateSpace:
        """The controller as a system; without A, B and C a gain."""
        q, m = len(self.inputs), len(self.outputs)
        parts = (self.A, self.B, self.C) if self.A else (np.zeros((0, 0)), np.zeros((0, q)), np.zeros((m, 0)))
        A, B, C, D = (real_array("Controller: a matrix", part) for part in (*parts, self.D))
        if D.shape != (m, q):
            both = f"{q} inputs and {m} outputs are named, and D has the shape {D.shape}"
            raise ConfigError(f"Controller: {both}; it has a row for every output, a column for every input.")
        return StateSpace(A, B, C, D, self.sample_period_s)

    @classmethod
    def from_system(cls, system: Any) -> Self:
        """Return the controller of a `control.StateSpace` whose inputs and outputs are named as the channels."""
        own, content = StateSpace.of(system), dict[str, Any]()
        content |= {name: getattr(own, name).tolist() for name in "ABCD"}
        content |= {f"{side}s": getattr(system, f"{side}_labels", ()) for side in ("input", "output")}
        return cls.of(content | {"sample_period_s": own.dt}, "Controller")

    def placed(self, observer: ObserverData, models: ModelSet) -> StateSpace:
        """Return it between all estimated states and all recorded inputs, in the units of the models."""
        dt, states, inputs = models.sample_period_s, observer.recorded, models.recorded_inputs
        if not np.isclose(self.sample_period_s, dt, rtol=AGREED):
            raise ConfigError(
                f"Controller: it is sampled at {self.sample_period_s} s, the models at {dt} s; convert it."
            )
        for what, names, known in (("input", self.inputs, states), ("output", self.outputs, inputs)):
            for name in names:
                if name not in known:
                    hint = did_you_mean(name, known) or ";"
                    raise ConfigError(f"Controller: {what} {name!r} is unknown{hint} there are {', '.join(known)}.")
        read = np.eye(len(states))[[states.index(name) for name in self.inputs]]
        write = np.eye(len(inputs))[:, [inputs.index(name) for name in self.outputs]]
        of_x, of_u = recorded_factors(observer, self.inputs), recorded_factors(observer, self.outputs)
        return gain(write * of_u, dt) @ replace(self.system, dt=dt) @ gain(read / of_x[:, None], dt)
