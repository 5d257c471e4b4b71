r"""Exact search for the nominal whose optimal cover is the smallest on average.

Every cover allows `left_i right_j >= |E_ij|` for every unit. For a coupling `pi` of rows and columns (non-negative, rows summing to 1 / p', columns
to 1 / m') this bounds its cost from below, whatever the cover:

    mean(log left) + mean(log right) = sum_ij pi_ij log(left_i right_j) >= sum_ij pi_ij log max_k |E_k,ij|

Residuals of a few units, the worst at every frequency of the candidates evaluated so far, are enough for a bound; candidates whose bound exceeds the
lowest cost found are never covered.
"""

from __future__ import annotations

from itertools import permutations
from typing import Any

import numpy as np
import numpy.typing as npt

from ..forms import Form, residual
from ..nominal.search import Found, first_best
from ..small_matrices import entries_first, sigma_max_first
from .cover import Structure, optimal_cover

Array = npt.NDArray[Any]

FLOOR_DB = -160.0  # smaller magnitudes count as this
_MOST = 24  # couplings that are enumerated
_TIE_DB = 1e-7


def search_cover(form: Form, responses: Array, extra: Array, allowed: Array, weights: Array, structure: Structure) -> Found:
    """Return the candidate with the lowest average cost of the optimal cover, in dB.

    Parameters
    ----------
    form : Form
    responses : ndarray, shape (unit, frequency, p, m), complex
    extra : ndarray, shape (extra, frequency, p, m), complex
        Candidates that are no units; they come after the units.
    allowed : ndarray of bool, shape (unit + extra,)
    weights : ndarray, shape (frequency,)
        Of the frequencies in the mean; their sum is one.
    structure : Structure

    Returns
    -------
    Found
    """
    n_freqs = responses.shape[1]
    entries: Array | None = None
    scores = np.where(allowed, FLOOR_DB, np.inf)
    evaluated = np.zeros(len(allowed), bool)
    best, bounds = np.inf, {}
    while True:
        waiting = np.flatnonzero(allowed & ~evaluated & (scores <= best + _TIE_DB))
        if not waiting.size:
            break
        row = int(waiting[np.argmin(scores[waiting])])
        E = residual(form, _candidate(responses, extra, row), responses)
        scores[row], evaluated[row] = cover_cost_db(E, weights, structure), True
        sizes = sigma_max_first(entries_first(E))
        bounds[row] = sizes.max(axis=0)
        best = min(best, float(scores[row]))
        witness = responses[np.argmax(sizes, axis=0), np.arange(n_freqs)]
        if entries is None:
            entries = np.zeros((len(allowed), n_freqs, *E.shape[-2:]))
        for other in np.flatnonzero(allowed & ~evaluated & (scores <= best + _TIE_DB)):
            seen = np.abs(residual(form, _candidate(responses, extra, int(other)), witness))
            entries[other] = np.maximum(entries[other], seen)
            scores[other] = max(scores[other], float(weights @ cost_from_below_db(entries[other])))
    index = first_best(np.where(evaluated, 10 ** (scores / 20), np.inf))
    return Found(index, bounds[index], scores, evaluated)


def cover_cost_db(E: Array, weights: Array, structure: Structure | str) -> float:
    """Return the mean over frequency of `Cover.cost_db`, where costs below -160 dB count as that."""
    with np.errstate(divide="ignore"):
        cost = optimal_cover(E, structure).cost_db()
    return float(weights @ np.maximum(cost, FLOOR_DB))


def cost_from_below_db(entries: Array) -> Array:
    """Return a lower bound of `Cover.cost_db`, shape (...), of every cover of entries of the size (..., p', m')."""
    with np.errstate(divide="ignore"):
        logs = np.maximum(20 * np.log10(entries), 10 * FLOOR_DB)
    costs = [np.einsum("...ij,ij->...", logs, coupling) for coupling in couplings(*entries.shape[-2:])]
    return np.maximum(np.max(costs, axis=0), FLOOR_DB)


def couplings(n_rows: int, n_columns: int) -> list[Array]:
    """Return couplings of rows and columns, each of shape (rows, columns): the even one, and assignments where there are few."""
    found = [np.full((n_rows, n_columns), 1 / (n_rows * n_columns))]
    if n_rows < n_columns:
        return [coupling.T for coupling in couplings(n_columns, n_rows)]
    if n_rows % n_columns or n_rows > 4:
        return found
    columns = np.repeat(np.arange(n_columns), n_rows // n_columns)
    for assignment in sorted(set(permutations(columns.tolist())))[:_MOST]:
        coupling = np.zeros((n_rows, n_columns))
        coupling[np.arange(n_rows), assignment] = 1 / n_rows
        found.append(coupling)
    return found


def _candidate(responses: Array, extra: Array, row: int) -> Array:
    return np.asarray(responses[row] if row < len(responses) else extra[row - len(responses)])
