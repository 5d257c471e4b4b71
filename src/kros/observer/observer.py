"""The observer as people use it: the data of `ObserverData`, to run, to start on a machine, to save and to load."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Self

import numpy as np

from ..core import Array, ArrayLike, Columns, Names, Parameters, Record, gain
from ..data import Shown
from ..lifting import Lifting
from ..synthesis.result import Injection
from .data import ObserverData
from .file import read_observer, write_observer
from .running import RunningObserver
from .simulate import run_observer


class Observer(Shown, ObserverData):
    """An observer; its fields are those of `ObserverData`.

    Examples
    --------
    >>> import numpy as np
    >>> from kros.lifting import Lifting
    >>> from kros.observer import Observer
    >>> plant = Lifting(("position", "velocity"))
    >>> A, B = np.array([[1.0, 0.1], [0.0, 0.9]]), np.array([[0.0], [0.1]])
    >>> observer = Observer.open_loop("model alone", plant, A, B, measured=(0,), inputs=("force",), sample_period_s=0.1)
    >>> running = observer.start([0.5])
    >>> running.step([0.5], [2.0])["velocity"]
    0.2
    """

    def _summary_rows(self) -> Record:
        order = f"{self.controller.n_states} of the correction, {self.internal} internal states"
        rows = {"name": self.name, "states": ", ".join(self.recorded), "measured": ", ".join(self.outputs)}
        rows |= {"inputs": ", ".join(self.inputs), "functions": ", ".join(self.lifting.functions), "order": order}
        return rows | {"period": f"{self.sample_period_s:g} s"}

    @classmethod
    def open_loop(
        cls,
        name: str,
        lifting: Lifting,
        A: Array,
        B: Array,
        measured: Columns,
        inputs: Names,
        sample_period_s: float,
    ) -> Self:
        """Return the nominal model without any correction."""
        controller = gain(np.zeros((len(A), len(measured))), sample_period_s)
        return cls(name, lifting, A, B, measured, inputs, controller, Injection.STATE, sample_period_s)

    def run(self, y: Array, u: Array, parameters: Parameters | None = None) -> Array:
        """Estimate a batch of episodes; see `run_observer`."""
        return run_observer(self, y, u, parameters)

    def start(self, y: ArrayLike, parameters: Mapping[str, float] | None = None, /, **own: float) -> RunningObserver:
        """Return a running observer that starts at a first measurement, shape (q,).

        The machine's own lifting parameters are given by name, ``start(y, phase=1.2)``, or as a mapping; the nominal
        unit's stand for others.

        Raises
        ------
        ConfigError
            When a parameter is unknown, missing or not finite.
        DimensionError
            When there are not as many measurements as the observer has.
        """
        return RunningObserver(self, y, {**self.parameters, **(parameters or {}), **own})

    def save(self, path: Path | str) -> None:
        """Write the observer as one JSON file that a person can read, with a checksum."""
        write_observer(self, Path(path))

    @classmethod
    def load(cls, path: Path | str) -> Self:
        """Read what `save` wrote, or what was written by hand in the same form.

        Raises
        ------
        DataError
            The content does not fit its checksum; a key is missing, unknown or of the wrong kind; a matrix has another
            shape, or an entry that is not a finite number; names repeat; an index or the period is out of range.
        """
        return cls(**vars(read_observer(Path(path))))
