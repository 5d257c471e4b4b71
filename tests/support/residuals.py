"""Residuals that are given as functions of frequency: units against a nominal of zero."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from kros.core.lti import StateSpace, gain
from kros.uncertainty import Form
from kros.uncertainty.weights.fit import Residuals

Array = np.ndarray[Any, Any]


def of_function(function: Callable[[Array], Array]) -> Residuals:
    """Return residuals, shape (unit, frequency, p, m), of a function of Hz."""
    units, _, p, m = function(np.array([0.1])).shape
    return Residuals(Form.ADDITIVE, lambda f: np.zeros((len(f), p, m)), lambda f, rows: function(f)[rows] + 0j, units)


def of_systems(form: str, nominal: StateSpace, units: StateSpace) -> Residuals:
    """Return the residuals of a form with the systems behind them."""
    return Residuals(
        Form(form),
        nominal.frequency_response,
        lambda f, some: units[some].frequency_response(f),
        units.batch_shape[0],
        (nominal, units),
    )


def of_units(units: StateSpace) -> Residuals:
    """Return units against a plant of zero."""
    return of_systems("additive", gain(np.zeros((units.n_outputs, units.n_inputs)), units.dt), units)
