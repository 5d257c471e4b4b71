"""A controller that uses estimates, as people give it: matrices and names of signals."""

from collections.abc import Sequence
from typing import Any, Self

import numpy as np
from pydantic import Field

from ...core import AGREED, Array, ConfigError, Names, Record, Settings, StateSpace, did_you_mean, gain
from ...core.lti import real_array
from ...identify import ModelSet
from ...observer import recorded_factors
from ...observer.data import ObserverData

Rows = tuple[tuple[float, ...], ...]


class Controller(Settings):
    """A discrete controller from estimates to inputs of the plant, by name, in the units of the recordings.

    Its output is added to the command, ``u = r + K x_hat``: one that opposes has the minus sign in it. Without A, B and
    C it is a gain.

    Examples
    --------
    >>> from kros.evaluate.closed_loop import Controller
    >>> Controller(D=[[-2.0]], sample_period_s=0.001, inputs=["velocity"], outputs=["voltage"]).limits
    {}
    """

    A: Rows = ()
    B: Rows = ()
    C: Rows = ()
    D: Rows
    sample_period_s: float
    inputs: Names
    outputs: Names
    limits: dict[str, tuple[float, float]] = Field({}, description="of the plant's inputs, where actuators have some")

    @classmethod
    def from_system(cls, system: Any) -> Self:
        """Return the controller of a `control.StateSpace` whose inputs and outputs are named as the channels."""
        content: Record = {name: np.asarray(getattr(system, name)).tolist() for name in "ABCD"}
        content |= {f"{side}s": getattr(system, f"{side}_labels", ()) for side in ("input", "output")}
        return cls.of(content | {"sample_period_s": system.dt}, "Controller")

    def between(self, observer: ObserverData, models: ModelSet) -> StateSpace:
        """Return the system from all estimated states to all recorded inputs, in the units of the models."""
        dt, n, q, m = models.sample_period_s, len(self.A), len(self.inputs), len(self.outputs)
        if not np.isclose(self.sample_period_s, dt, rtol=AGREED):
            raise ConfigError(f"Controller: sampled at {self.sample_period_s} s, the models at {dt} s; convert it.")
        matrices = []
        for name, shape in {"A": (n, n), "B": (n, q), "C": (m, n), "D": (m, q)}.items():
            matrix = real_array(f"Controller: {name}", getattr(self, name))
            if matrix.size != np.prod(shape) or (matrix.size and matrix.shape != shape):
                named = f"with {q} inputs and {m} outputs named, {n} states"
                raise ConfigError(f"Controller: {name} should have the shape {shape} {named}, found {matrix.shape}.")
            matrices.append(matrix.reshape(shape))
        read = self._places(observer, self.inputs, observer.recorded)
        write = self._places(observer, self.outputs, models.recorded_inputs)
        A, B, C, D = matrices
        return gain(write, dt) @ StateSpace(A, B, C, D, dt) @ gain(np.linalg.pinv(read), dt)

    def ends(self, observer: ObserverData, known: Sequence[str]) -> Array:
        """Return the lowest and highest value of all known inputs, in the units of the models, (2, known)."""
        factors = self._places(observer, tuple(self.limits), known).sum(axis=0)
        ends = np.tile([[-np.inf], [np.inf]], len(known))
        ends[:, [known.index(name) for name in self.limits]] = np.sort(factors * np.array([*self.limits.values()]).T, 0)
        return ends

    @staticmethod
    def _places(observer: ObserverData, names: Sequence[str], known: Sequence[str]) -> Array:
        """Return what the recorded value of every named signal is in all that are known, (known, names)."""
        for name in names:
            if name not in known:
                hint = did_you_mean(name, known)
                raise ConfigError(f"Controller: signal {name!r} is unknown{hint} there are {', '.join(known)}.")
        return np.eye(len(known))[:, [known.index(name) for name in names]] * recorded_factors(observer, names)
