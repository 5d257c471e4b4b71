"""Distances of units from one another, in dB relative to their typical size.

responses (unit, frequency, p, m) --residuals from every nominal--> scaled to typical entries of one --sigma_max,
smoothed--> levels in dB

Entries are scaled by their typical size over all pairs (Sinkhorn scaling of the median squared magnitudes), so that
every row and column of the residual counts alike, at every frequency by itself.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from ...core.small_matrices import entries_first, sigma_max_first, squared
from ..forms import Form, residual

Array = npt.NDArray[Any]

MOST_NOMINALS = 64
MOST_PAIRS = MOST_NOMINALS * 4096  # beyond, there are fewer nominals, but
FEW_NOMINALS = 16  # at least
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
    # (nominal, unit, frequency), dB: largest singular value of the scaled residual, smoothed; NaN against itself
    by_nominal: Array
    levels: Array  # (unit, frequency), dB: the median over the nominals
    left: Array  # (frequency, p'): typical size of the residual's rows
    right: Array  # (frequency, m'): of its columns


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
        scales = typical(_middle(squared(E[~own])))
        sigma.append(sigma_max_first(entries_first(E / scales[0][:, :, None] / scales[1][:, None, :])))
        left.append(scales[0])
        right.append(scales[1])
    level = _smooth(20 * np.log10(np.maximum(np.concatenate(sigma, axis=2), _LEAST)), freqs_hz)
    level[own] = np.nan
    return Distances(nominals, level, _median(level, own), np.concatenate(left), np.concatenate(right))


def joined(form: Form, known: Distances, rows: Array, nominals: Array, response: Array, freqs_hz: Array) -> Distances:
    """Return distances of some units of a population, and of one more, which comes last."""
    there = np.flatnonzero(np.isin(known.nominals, rows))
    own = scaled_levels(form, nominals[there], response, known, freqs_hz)
    levels = np.concatenate([known.levels[rows], np.median(own, axis=0)[None]])
    few = np.unique(
        np.linspace(0, len(there) - 1, FEW_NOMINALS).round().astype(int)
    )  # what is said of every nominal by itself is said of these
    some = there[few]
    by_nominal = np.concatenate([known.by_nominal[np.ix_(some, rows)], own[few, None]], axis=1)
    return Distances(np.searchsorted(rows, known.nominals[some]), by_nominal, levels, known.left, known.right)


def scaled_levels(form: Form, nominal: Array, perturbed: Array, found: Distances, freqs_hz: Array) -> Array:
    """Return smoothed levels of residuals in the scales of a population, shape (..., frequency), dB."""
    E = residual(form, nominal, perturbed) / found.left[:, :, None] / found.right[:, None, :]
    return _smooth(20 * np.log10(np.maximum(sigma_max_first(entries_first(E)), _LEAST)), freqs_hz)


def largest_entries(form: Form, responses: Array, found: Distances, units: Array, rows: Array) -> list[tuple[int, int]]:
    """Return the entries of units' residuals that are largest for their typical size, each at its own frequency."""
    nominal, perturbed = responses[found.nominals[:, None], rows], responses[units, rows]
    size = (
        np.abs(residual(form, nominal, perturbed[None])) / found.left[rows][:, :, None] / found.right[rows][:, None, :]
    )
    own = found.nominals[:, None] == units
    middle = _median(size, own)
    entries = [np.unravel_index(int(np.argmax(m)), m.shape) for m in middle]
    return [(int(i), int(j)) for i, j in entries]


def typical(squares: Array) -> tuple[Array, Array]:
    """Return left and right scales that bring squared entries to equal row and column sums."""
    row = _positive(squares.max(axis=2, keepdims=True))
    column = _positive((squares / row).max(axis=1, keepdims=True))
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
    """All units, or 64 (of thousands fewer) spread evenly over their distances from the entrywise median."""
    if len(G) <= MOST_NOMINALS:
        return np.arange(len(G))
    middle = np.median(G.real, axis=0) + 1j * np.median(G.imag, axis=0)
    size = np.maximum(np.abs(middle), np.finfo(float).tiny)
    order = np.argsort((np.abs(G - middle) / size).mean(axis=(1, 2, 3)), kind="stable")
    most = int(np.clip(MOST_PAIRS // len(G), FEW_NOMINALS, MOST_NOMINALS))
    return np.sort(order[np.linspace(0, len(G) - 1, most).round().astype(int)])


def _same(G: Array, nominals: Array) -> npt.NDArray[np.bool_]:
    """Tell where nominal and unit are equal but for rounding, shape (nominal, unit, frequency)."""
    size = np.abs(G).max(axis=(2, 3))
    return np.stack([np.abs(G - G[k]).max(axis=(2, 3)) <= _EQUAL * np.maximum(size, size[k]) for k in nominals])


def _positive(values: Array) -> Array:
    return np.where(values > 0, values, 1.0)


def _middle(squares: Array) -> Array:
    """Median over the pairs; the mean at frequencies where most pairs are equal."""
    median = np.median(squares, axis=0)
    equal = median.max(axis=(1, 2)) == 0
    median[equal] = squares[:, equal].mean(axis=0)
    return median


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
