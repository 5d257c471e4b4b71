"""What generated code loses: its estimates beside Python's on held-out recordings."""

from __future__ import annotations

import tempfile
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from ...observer import Observer, run_observer, track_parameter
from ...observer.units import recorded_factors
from .compiled import CompiledObserver

Array = npt.NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class HeldOut:
    """Recordings that an exported observer is tried on.

    Parameters
    ----------
    y, u : ndarray, shape (n_samples, batch, q), (n_samples, batch, m)
        As they arrive, in the channels' units.
    states : ndarray, shape (n_samples, batch, n_recorded)
        The truth.
    parameters : mapping of str to ndarray, shape (batch,)

    Examples
    --------
    >>> import numpy as np
    >>> from kros.export import HeldOut
    >>> recordings = HeldOut(np.zeros((100, 2, 1)), np.zeros((100, 2, 1)), np.zeros((100, 2, 3)))
    >>> recordings.y.shape
    (100, 2, 1)
    """

    y: Array
    u: Array
    states: Array
    parameters: Mapping[str, Array] = field(default_factory=dict)


@dataclass(frozen=True)
class Accuracy:
    """How far generated code is from Python."""

    samples: int
    difference: float
    loss_percent: Mapping[str, float]

    @classmethod
    def of(cls, files: Mapping[str, str], observer: Observer, held_out: HeldOut, track: str | None) -> Accuracy:
        """Compile the files of an export and run both."""
        y, u, own = held_out.y, held_out.u, observer.own(held_out.parameters)
        wanted = (
            run_observer(observer, y, u, own)
            if track is None
            else track_parameter(observer, y, u, own, track).estimates
        )
        wanted, found = wanted[..., : len(observer.recorded)], np.empty((*y.shape[:2], len(observer.recorded)))
        found[0] = wanted[0]
        measured = [observer.lifting.states[i] for i in observer.measured]
        y_factor, u_factor, x_factor = (
            recorded_factors(observer, names) for names in (measured, observer.inputs, observer.recorded)
        )
        with tempfile.TemporaryDirectory() as name:
            for file, text in files.items():
                Path(name, file).write_text(text)
            compiled = CompiledObserver.build(name)
            for i in range(y.shape[1]):
                values = {p: float(np.asarray(v)[i]) for p, v in own.items()}
                found[1:, i] = compiled.run(y[:, i] / y_factor, u[:, i] / u_factor, values)[0][:-1] * x_factor
        apart, size = _rms(found - wanted), np.std(wanted, axis=(0, 1))
        errors = _rms(wanted - held_out.states), _rms(found - held_out.states)
        loss = 100 * (errors[1] / np.maximum(errors[0], 1e-300) - 1)
        return cls(
            y[..., 0].size,
            float(np.max(apart / np.maximum(size, 1e-300))),
            dict(zip(observer.recorded, loss.tolist(), strict=True)),
        )

    def content(self) -> dict[str, Any]:
        """Return what a manifest holds of it, rounded: compilers differ in the last digits."""
        loss = {
            name: round(value, 3) + 0.0 if np.isfinite(value) else None for name, value in self.loss_percent.items()
        }
        return {"samples": self.samples, "difference": float(f"{self.difference:.0e}"), "loss_percent": loss}


def _rms(values: Array) -> Array:
    return np.asarray(np.sqrt(np.mean(values**2, axis=(0, 1))))
