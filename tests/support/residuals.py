"""Residuals that are given as functions of frequency: units against a nominal of zero."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

from kros.core.lti import StateSpace
from kros.uncertainty import Form
from kros.uncertainty.weights.fit import Residuals

Array = np.ndarray[Any, Any]


@dataclass(frozen=True)
class Responses:
    """Some units of a function of Hz, shape (unit, frequency, p, m)."""

    function: Callable[[Array], Array]
    rows: Any = ...

    def __getitem__(self, rows: Any) -> Responses:
        return Responses(self.function, rows)

    def frequency_response(self, freqs_hz: Array) -> Array:
        return self.function(freqs_hz)[self.rows] + 0j


def of_function(function: Callable[[Array], Array]) -> Residuals:
    """Return residuals, shape (unit, frequency, p, m), of a function of Hz."""
    units, _, p, m = function(np.array([0.1])).shape
    return Residuals(Form.ADDITIVE, Responses(lambda f: np.zeros((len(f), p, m))), Responses(function), units)


def of_systems(form: str, nominal: StateSpace, units: StateSpace, remainder: bool = False) -> Residuals:
    """Return the residuals of a form with the systems behind them."""
    return Residuals(Form(form), nominal, units, units.batch_shape[0], remainder)
