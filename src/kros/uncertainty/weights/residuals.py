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
from ..settings import FIT, SET
from .proof import ResidualSystems

Array = npt.NDArray[Any]


@dataclass(frozen=True, eq=False)
class Residuals:
    """Residuals of scaled units against a nominal, or remainders of the form, as functions of frequency, Hz."""

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

    def blocks(self, size: int | None = None) -> Iterator[Array]:
        """Yield positions of units, so many at a time."""
        size = size or FIT.block
        return (np.arange(start, min(start + size, len(self))) for start in range(0, len(self), size))

    @cached_property
    def _known(self) -> dict[bytes, Array]:
        return {}

    def at(self, freqs_hz: Array) -> Array:
        """Return residuals, shape (unit, frequency, p', m'); fits, checks and proofs ask for the same frequencies."""
        key = freqs_hz.tobytes()
        if key not in self._known:
            G, step = self.nominal(freqs_hz), max(1, SET.at_once // max(1, len(freqs_hz)))
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
        return ResidualSystems(self.form, self.systems[0], self.systems[1][self.rows], self.remainder)

    def modes_hz(self, grid_hz: Array) -> Array:
        """Return frequencies of modes that a grid from DC to Nyquist passes over; none of responses alone."""
        return np.zeros(0) if self.realised is None else replace(self.realised, remainder=False).modes_hz(grid_hz)

    def deciding(self, freqs_hz: Array) -> Residuals:
        """Return those of units that are the largest at some frequency, by singular value or by an entry."""
        if len(self) <= FIT.block:
            return self
        largest, who = [], []
        for rows in self.blocks():
            E = self.of(rows).at(freqs_hz)
            entries = np.moveaxis(np.abs(E).reshape(*E.shape[:2], -1), 2, 0)
            sizes = np.concatenate([sigma_max(E)[None], entries])
            largest.append(sizes.max(axis=1))
            who.append(rows[sizes.argmax(axis=1)])
        return self.of(np.unique(np.take_along_axis(np.array(who), np.argmax(largest, axis=0)[None], axis=0)))
