"""Residuals of the units of a population at any frequency, and the systems behind them where these are known."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
import numpy.typing as npt

from ...core.lti import StateSpace
from ..forms import Form, completion, residual
from ..settings import SET
from .cover import Cover
from .proof import ResidualSystems

Array = npt.NDArray[Any]


@dataclass(frozen=True, eq=False)
class Residuals:
    """Residuals of scaled units against a nominal, or remainders of the form, as functions of frequency, Hz."""

    form: Form
    nominal: Callable[[Array], Array]  # response (frequency, p, m)
    units: Callable[[Array, slice], Array]  # responses (unit, frequency, p, m) of some units
    count: int  # of units
    systems: tuple[StateSpace, StateSpace] | None = None  # nominal and units, whose modes and pencils are looked at
    remainder: bool = False

    def pieces(self, freqs_hz: Array) -> Iterator[tuple[Array, Array]]:
        """Yield responses and residuals, a few units at a time: memory does not grow with their number."""
        G, step = self.nominal(freqs_hz), max(1, SET.at_once // max(1, len(freqs_hz)))
        for start in range(0, self.count, step):
            Gp = self.units(freqs_hz, slice(start, start + step))
            yield Gp, completion(self.form, G, Gp)[1] if self.remainder else residual(self.form, G, Gp)

    def at(self, freqs_hz: Array) -> Array:
        """Return residuals, shape (unit, frequency, p', m')."""
        return np.concatenate([E for _, E in self.pieces(freqs_hz)])

    def ratio(self, cover: Cover, freqs_hz: Array) -> Array:
        """Return the ratios of all units to a cover at the same frequencies, shape (unit, frequency)."""
        return np.concatenate([cover.ratio(E) for _, E in self.pieces(freqs_hz)])

    @cached_property
    def realised(self) -> ResidualSystems | None:
        """The systems behind these residuals."""
        return None if self.systems is None else ResidualSystems(self.form, *self.systems, self.remainder)
