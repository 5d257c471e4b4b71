r"""Exact search for the candidate whose largest residual is smallest, without visiting all pairs.

A candidate's bound is the largest residual over the units, `b_c(f) = max_k sigma(E(c, k, f))`; any units and
frequencies that were looked at give a bound of `b_c` from below. The search evaluates the candidate with the lowest
such bound over *all* units, asks which unit was the worst at every frequency, and raises the lower bounds of all other
candidates by these witnesses. A candidate whose lower bound exceeds the best score so far is never evaluated; when none
is left below, the best is the best of all: nothing is assumed about the population. A population has few extreme units,
so that few rounds are needed; each visits as many pairs as there are units, not their square.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from ...core.arrays import AnyArray
from ...core.rounding import ITERATED

TIE = ITERATED  # relative; scores closer than rounding are one
_AT_ONCE = 10_000  # units times frequencies in a piece of a computation, which stays in a processor's cache


def smallest_largest(shape: tuple[int, int], size: Callable[[AnyArray, AnyArray], AnyArray]) -> tuple[int, AnyArray]:
    """Return the best of the units as candidates, and its bound; of a `shape` (unit, frequency).

    ``size(candidates, units)`` returns residuals, (row, frequency), for rows that broadcast to that: of a candidate and
    all units, (1, 1) and (row, 1), and of candidates and the witness of every frequency, (row, 1) and (1, frequency).
    """
    lower, exact, row, step = np.zeros(shape), np.full(shape[0], np.inf), 0, max(1, _AT_ONCE // shape[1])
    while lower[row].max() <= exact.min() * (1 + TIE):
        at = np.array([[row]])
        residuals = np.concatenate([size(at, part) for part in _pieces(np.arange(shape[0]), step)])
        lower[row] = residuals.max(axis=0)
        exact[row] = lower[row].max()
        rows = np.flatnonzero(np.isinf(exact) & (lower.max(axis=1) <= exact.min() * (1 + TIE)))
        if not rows.size:
            break
        witness = residuals.argmax(axis=0)[None]
        lower[rows] = np.maximum(lower[rows], np.concatenate([size(part, witness) for part in _pieces(rows, step)]))
        row = int(rows[np.argmin(lower[rows].max(axis=1))])
    least = exact.min()
    index = int(np.argmax(exact <= least + TIE * np.abs(least)))  # the first of those that rounding may have told apart
    return index, lower[index]


def _pieces(rows: AnyArray, step: int) -> list[AnyArray]:
    return np.split(rows[:, None], range(step, len(rows), step))
