"""Residuals of the units of a population at any frequency, and the systems behind them where these are known."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np
import numpy.typing as npt

from ...core.lti import StateSpace
from ...core.small_matrices import sigma_max
from ..forms import Form, completion, residual
from .pencils import ResidualSystems

Array = npt.NDArray[Any]

_PIECE = 10_000  # units times frequencies in one piece of a computation, which then stays in the cache of a processor


@dataclass(frozen=True, eq=False)
class Residuals:
    """Residuals of scaled units against a nominal, or what the form leaves out, as functions of frequency, Hz."""

    form: Form
    nominal: Callable[[Array], Array]  # response (frequency, p, m)
    units: Callable[[Array, Array], Array]  # responses (unit, frequency, p, m) of some rows
    rows: Array  # (unit,): units that are looked at
    systems: tuple[StateSpace, StateSpace] | None = None  # nominal and units, discrete, whose modes are looked at
    proven: bool = True  # whether the systems have these residuals at all frequencies
    remainder: bool = False

    def __len__(self) -> int:
        return len(self.rows)

    def of(self, rows: Array) -> Residuals:
        """Return those of some units."""
        return self if len(rows) == len(self) else replace(self, rows=self.rows[rows])

    def blocks(self, size: int) -> Iterator[Array]:
        """Yield positions of units, so many at a time."""
        return (np.arange(start, min(start + size, len(self))) for start in range(0, len(self), size))

    @cached_property
    def _known(self) -> dict[bytes, Array]:
        return {}

    def at(self, freqs_hz: Array) -> Array:
        """Return residuals, shape (unit, frequency, p', m'); fits, checks and proofs ask for the same frequencies."""
        key = freqs_hz.tobytes()
        if key not in self._known:
            G, step = self.nominal(freqs_hz), max(1, _PIECE // max(1, len(freqs_hz)))
            self._known[key] = np.concatenate([self._of(G, freqs_hz, rows) for rows in self.blocks(step)])
        return self._known[key]

    def _of(self, G: Array, freqs_hz: Array, rows: Array) -> Array:
        Gp = self.units(freqs_hz, self.rows[rows])
        return completion(self.form, G, Gp)[1] if self.remainder else residual(self.form, G, Gp)

    @cached_property
    def realised(self) -> ResidualSystems | None:
        """The systems behind these residuals."""
        if self.systems is None:
            return None
        nominal, units = self.systems
        return ResidualSystems(self.form, nominal, units[self.rows], self.remainder)

    def modes_hz(self, grid_hz: Array) -> Array:
        """Return frequencies around modes that a grid from DC to Nyquist passes over; none of responses alone."""
        if self.realised is None:
            return np.zeros(0)
        return replace(self.realised, remainder=False).modes_hz(grid_hz)

    def deciding(self, freqs_hz: Array, block: int) -> Array:
        """Return the units that are the largest at some frequency, by singular value or by an entry; all if few."""
        best: tuple[Array, Array] | None = None
        if len(self) <= block:
            return np.arange(len(self))
        for rows in self.blocks(block):
            E = self.of(rows).at(freqs_hz)
            entries = np.moveaxis(np.abs(E).reshape(*E.shape[:2], -1), 2, 0)
            sizes = np.concatenate([sigma_max(E)[None], entries])
            largest, who = sizes.max(axis=1), rows[sizes.argmax(axis=1)]
            if best is not None:
                who = np.where(largest > best[0], who, best[1])
                largest = np.maximum(largest, best[0])
            best = largest, who
        return np.unique(best[1]) if best is not None else np.arange(0)
