"""Distances of units from one another, in dB relative to their typical size.

responses (unit, frequency, p, m) --residuals from every nominal--> scaled to typical entries of one --sigma_max,
smoothed--> levels in dB

Entries are scaled by their typical size over all pairs (Sinkhorn scaling of the median squared magnitudes), so that
every row and column of the residual counts alike, at every frequency by itself.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import numpy.typing as npt

from ...core.small_matrices import entries_first, sigma_max_first, squared
from ..forms import Form, residual

Array = npt.NDArray[Any]

_MOST_NOMINALS = 64
_SMOOTHING_DECADES = 1.0 / 3.0
_SINKHORN = 50
_SMALLEST = 1e-12  # relative to the largest typical entry of row and column
_EQUAL = 1e-12  # responses that differ by less, relative to the larger, are the same
_LEAST = 1e-10  # distance of responses that are the same, relative to the typical one
_AT_ONCE = 4_000_000  # complex numbers of residuals in memory


@dataclass(frozen=True, eq=False)
class Distances:
    """Distances of all units."""

    nominals: Array  # (nominal,): rows of the units that were the nominal in turn
    peaks: Array  # (nominal, unit), dB: largest level with one nominal; NaN against itself
    levels: Array  # (unit, frequency), dB: smoothed singular value of the scaled residual, median over the nominals
    left: Array  # (frequency, p'): typical size of the residual's rows
    right: Array  # (frequency, m'): of its columns

    def joined(self, levels: Array) -> Distances:
        """Return the distances with one more unit, whose levels (nominal, frequency) are known; it comes last."""
        peaks = np.hstack([self.peaks, levels.max(axis=1)[:, None]])
        return replace(self, peaks=peaks, levels=np.vstack([self.levels, np.median(levels, axis=0)]))


def distances(form: Form, responses: Array, freqs_hz: Array) -> Distances:
    """Return the distances of all units, shape (unit, frequency, p, m), in scaled coordinates."""
    G = responses
    nominals = _nominals(G)
    own = nominals[:, None] == np.arange(len(G))
    step = max(1, _AT_ONCE // (len(nominals) * len(G) * max(G.shape[2:]) ** 2))
    sigma, left, right = [], [], []
    for start in range(0, G.shape[1], step):
        part = G[:, start : start + step]
        E = np.stack([residual(form, part[k], part) for k in nominals])  # (nominal, unit, frequency, p', m')
        E[_same(part, nominals)] = 0.0
        squares = squared(E[~own])
        middle = np.median(squares, axis=0)
        equal = middle.max(axis=(1, 2)) == 0  # most pairs are
        middle[equal] = squares[:, equal].mean(axis=0)
        scales = typical(middle)
        sigma.append(sigma_max_first(entries_first(E / scales[0][:, :, None] / scales[1][:, None, :])))
        left.append(scales[0])
        right.append(scales[1])
    level = _smooth(20 * np.log10(np.maximum(np.concatenate(sigma, axis=2), _LEAST)), freqs_hz)
    level[own] = np.nan
    return Distances(nominals, level.max(axis=2), _median(level, own), np.concatenate(left), np.concatenate(right))


def scaled_levels(form: Form, nominal: Array, perturbed: Array, found: Distances, freqs_hz: Array) -> Array:
    """Return smoothed levels of residuals in the scales of a population, shape (..., frequency), dB."""
    E = residual(form, nominal, perturbed) / found.left[:, :, None] / found.right[:, None, :]
    return _smooth(20 * np.log10(np.maximum(sigma_max_first(entries_first(E)), _LEAST)), freqs_hz)


def largest_entries(form: Form, responses: Array, found: Distances, units: Array, rows: Array) -> list[tuple[int, int]]:
    """Return the entries of units' residuals that are largest for their typical size, each at its own frequency."""
    nominal, perturbed = responses[found.nominals[:, None], rows], responses[units, rows]
    size = np.abs(residual(form, nominal, perturbed[None]))
    scaled = size / found.left[rows][:, :, None] / found.right[rows][:, None, :]
    middle = _median(scaled, found.nominals[:, None] == units)
    entries = [np.unravel_index(int(np.argmax(m)), m.shape) for m in middle]
    return [(int(i), int(j)) for i, j in entries]


def typical(squares: Array) -> tuple[Array, Array]:
    """Return left and right scales that bring squared entries to equal row and column sums."""
    row = squares.max(axis=2, keepdims=True)
    row[row <= 0] = 1.0
    column = (squares / row).max(axis=1, keepdims=True)
    column[column <= 0] = 1.0
    weights = np.maximum(squares / row / column, _SMALLEST)
    left, right = np.ones(weights.shape[:2]), np.ones((weights.shape[0], weights.shape[2]))
    for _ in range(_SINKHORN):
        left = (weights / right[:, None, :]).sum(axis=2)
        right = (weights / left[:, :, None]).sum(axis=1)
    return np.sqrt(left * row[:, :, 0]), np.sqrt(right * column[:, 0])


def balance(responses: Array) -> tuple[Array, Array]:
    """Return ranges of outputs and inputs from responses themselves."""
    left, right = typical(np.median(squared(responses), axis=(0, 1))[None])
    return left[0], 1 / right[0]


def _nominals(G: Array) -> Array:
    """All units, or 64 spread evenly over their distances from the entrywise median."""
    if len(G) <= _MOST_NOMINALS:
        return np.arange(len(G))
    middle = np.median(G.real, axis=0) + 1j * np.median(G.imag, axis=0)
    size = np.maximum(np.abs(middle), np.finfo(float).tiny)
    order = np.argsort((np.abs(G - middle) / size).mean(axis=(1, 2, 3)), kind="stable")
    return np.sort(order[np.linspace(0, len(G) - 1, _MOST_NOMINALS).round().astype(int)])


def _same(G: Array, nominals: Array) -> npt.NDArray[np.bool_]:
    """Tell where nominal and unit are equal but for rounding, shape (nominal, unit, frequency)."""
    size = np.abs(G).max(axis=(2, 3))
    return np.stack([np.abs(G - G[k]).max(axis=(2, 3)) <= _EQUAL * np.maximum(size, size[k]) for k in nominals])


def _median(values: Array, own: npt.NDArray[np.bool_]) -> Array:
    """Median over the nominals, shape (unit, ...), a unit's own left out."""
    ordered = values.copy()
    ordered[own] = np.inf
    ordered.sort(axis=0)
    last = len(own) - own.sum(axis=0)  # number of nominals of each unit
    units = np.arange(own.shape[1])
    return np.asarray((ordered[(last - 1) // 2, units] + ordered[last // 2, units]) / 2)


def _smooth(level: Array, freqs: Array) -> Array:
    """Moving average over log frequency, to a billionth of a dB."""
    x = np.log10(freqs)
    near = (np.abs(x[:, None] - x) <= _SMOOTHING_DECADES / 2).astype(float)
    return np.asarray(np.round(level @ (near / near.sum(axis=0)), 9))
