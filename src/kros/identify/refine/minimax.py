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


def smallest_largest(
    shape: tuple[int, int],
    bound_of: Callable[[int], tuple[AnyArray, AnyArray]],
    against: Callable[[AnyArray, AnyArray], AnyArray],
) -> tuple[int, AnyArray, AnyArray, AnyArray]:
    """Return the best candidate, its bound, all scores (lower bounds where not evaluated), and which are exact."""
    lower, scores, evaluated = np.zeros(shape), np.zeros(shape[0]), np.zeros(shape[0], bool)
    best, row = np.inf, 0
    while scores[row] <= best * (1 + TIE):
        lower[row], witness = bound_of(row)
        scores[row], evaluated[row] = float(lower[row].max()), True
        best = min(best, scores[row])
        rows = np.flatnonzero(~evaluated & (scores <= best * (1 + TIE)))
        if not rows.size:
            break
        lower[rows] = np.maximum(lower[rows], against(rows, witness))
        scores[rows] = np.maximum(scores[rows], lower[rows].max(axis=1))
        row = int(rows[np.argmin(scores[rows])])
    exact = np.where(evaluated, scores, np.inf)
    least = exact.min()
    index = int(np.argmax(exact <= least + TIE * np.abs(least)))  # the first of those that rounding may have told apart
    return index, lower[index], scores, evaluated
