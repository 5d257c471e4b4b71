"""The smallest change of a unit that its score would have shown, as a change of gain.

A level in dB says little to people who build machines. One entry of a unit's response, changed by one percent, is a residual of some level at
every frequency; a level is proportional to the change to first order, so what it takes to reach the bound follows in percent.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt

from ..forms import Form
from .distances import Distances, scaled_levels

Array = npt.NDArray[Any]

_PERCENT = 1.0
_MOST = 12  # units whose changes are tried


def change_levels(form: Form, responses: Array, found: Distances, freqs_hz: Array) -> Array:
    """Return levels of residuals between units and themselves with one entry changed by one percent.

    Parameters
    ----------
    form : Form
    responses : ndarray, shape (unit, frequency, p, m), complex
        In scaled coordinates.
    found : Distances
        Gives the scales of the residuals.
    freqs_hz : ndarray, shape (frequency,), Hz

    Returns
    -------
    ndarray, shape (p, m, frequency), dB
        The median over the units.
    """
    G = responses[np.unique(np.linspace(0, len(responses) - 1, min(_MOST, len(responses))).round().astype(int))]
    levels = np.empty((*G.shape[2:], G.shape[1]))
    for i, j in np.ndindex(*G.shape[2:]):
        changed = G.copy()
        changed[:, :, i, j] *= 1 + _PERCENT / 100
        levels[i, j] = np.median(scaled_levels(form, G, changed, found, freqs_hz), axis=0)
    return levels


def smallest_change(change: Array, cover: Array, bound_db: float) -> tuple[float, int, tuple[int, int]]:
    """Return the smallest change of gain that exceeds a cover by a bound, its frequency and its entry.

    Parameters
    ----------
    change : ndarray, shape (p, m, frequency), dB
        From `change_levels`.
    cover : ndarray, shape (frequency,), dB
    bound_db : float, dB

    Returns
    -------
    tuple of float, int and tuple of int
        Percent; infinity, the first frequency and the first entry where there is no bound.
    """
    if not np.isfinite(bound_db):
        return float("inf"), 0, (0, 0)
    percent = _PERCENT * 10 ** ((cover + bound_db - change) / 20)
    i, j, row = (int(k) for k in np.unravel_index(int(np.argmin(percent)), percent.shape))
    return float(percent[i, j, row]), row, (i, j)
