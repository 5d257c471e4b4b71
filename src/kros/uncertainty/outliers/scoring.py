"""Scores of units from distances: who covers whom, and what a unit exceeds that by.

Beside a score stands the smallest change of a unit that it would have shown, as a change of gain: a level in dB says little to people who build
machines. One entry of a unit's response, changed by one percent, is a residual of some level at every frequency; a level is proportional to the change
to first order, so what it takes to reach the bound follows in percent.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from ..forms import Form
from .distances import Distances, largest_entries, scaled_levels
from .score import OutlierScore, Status, room_db
from .separation import excess, held
from .tail import leave_one_out_bounds

Array = npt.NDArray[Any]

_PERCENT = 1.0
_MOST = 12  # units whose changes are tried


@dataclass(frozen=True, eq=False)
class Nominals:
    """Excess of every unit with one nominal at a time, shape (nominal, unit), and whether it is beyond its threshold."""

    excess_db: Array
    beyond: Array

    @classmethod
    def of(cls, found: Distances, inliers: npt.NDArray[np.bool_], rate: float) -> Nominals:
        """Score all units under every nominal, inliers among themselves and each other unit alone with them."""
        shape = found.by_nominal.shape[:2]
        values, beyond = np.full(shape, np.nan), np.zeros(shape, bool)
        for row, nominal in enumerate(found.nominals):
            others = np.arange(shape[1]) != nominal
            for units, members in _comparisons(inliers & others, others):
                score, margin = margins_of(found.by_nominal[row, members], rate)
                at = np.searchsorted(members, units)
                values[row, units], beyond[row, units] = score[at], margin[at] > 0
        return cls(values, beyond)

    def summary(self, unit: int) -> dict[str, Any]:
        """Return lowest and highest excess and agreement."""
        known = np.isfinite(self.excess_db[:, unit])
        values = self.excess_db[known, unit]
        return {
            "lowest_db": float(values.min()),
            "highest_db": float(values.max()),
            "agreement": float(self.beyond[known, unit].mean()),
        }


def _comparisons(inliers: npt.NDArray[np.bool_], wanted: npt.NDArray[np.bool_]) -> list[tuple[Array, Array]]:
    """Units, and the units that they are scored among: inliers together, every other unit alone with them."""
    together = np.flatnonzero(inliers)
    alone = [(np.array([k]), np.sort(np.append(together, k))) for k in np.flatnonzero(wanted & ~inliers)]
    return [(together, together), *alone] if len(together) > 1 else alone


def margins_of(levels: Array, rate: float) -> tuple[Array, Array]:
    """Excess of all units, and what it has beyond the bound of the others' scores."""
    if len(levels) < 2:
        return np.zeros(len(levels)), np.full(len(levels), -np.inf)
    scores = excess(levels)[0]
    return scores, scores - leave_one_out_bounds(scores, rate)


def scores_of(
    form: Form,
    G: Array,
    freqs: Array,
    found: Distances,
    inliers: npt.NDArray[np.bool_],
    margins: tuple[float, ...],
    ids: tuple[str, ...],
    threshold: float,
    summary: Nominals,
    units: Sequence[int],
) -> tuple[OutlierScore, ...]:
    """Scores of some units; `margins` and `ids` are theirs."""
    wanted = np.isin(np.arange(len(G)), np.asarray(units))
    value, where = np.zeros(len(G)), np.zeros(len(G), int)
    for some, members in _comparisons(inliers, wanted | inliers):
        rank, (score, peak) = np.searchsorted(members, some), excess(found.levels[members])
        value[some], where[some] = score[rank], peak[rank]
    rows = where[list(units)]
    entries = largest_entries(form, G, found, np.asarray(units), rows)
    change = change_levels(form, G[inliers], found, freqs)
    cover = _without_one(found.levels, inliers)
    scores = []
    for k, unit, margin, row, entry in zip(units, ids, margins, rows, entries, strict=True):
        known = np.isfinite(threshold) and np.isfinite(margin)
        referred = threshold + margin if known else float(value[k])
        beyond = bool(np.isfinite(threshold) and margin > 0)
        bound = float(value[k]) - margin if known else float("inf")
        percent, at, changed = smallest_change(change, held(cover(k)), bound)
        status = Status.OUTLIER if beyond else Status.OK if room_db(bound, percent) >= 0 else Status.CANNOT_TELL
        found_score = OutlierScore(
            unit=unit,
            score_db=referred,
            threshold_db=threshold,
            outlier=beyond,
            freq_hz=float(freqs[row]),
            entry=entry,
            excess_db=float(value[k]),
            **summary.summary(k),
            status=status,
            detectable_db=bound,
            detectable_percent=percent,
            detectable_hz=float(freqs[at]) if known else None,
            detectable_entry=changed,
        )
        scores.append(found_score)
    return tuple(scores)


def _without_one(levels: Array, inliers: npt.NDArray[np.bool_]) -> Callable[[int], Array]:
    """Return what gives the largest levels of all inliers but one unit, shape (frequency,)."""
    here = np.flatnonzero(inliers)
    ordered = np.argpartition(levels[here], max(len(here) - 2, 0), axis=0)[-2:]
    largest, top = levels[here].max(axis=0), here[ordered[-1]]
    second = levels[here[ordered[0]], np.arange(levels.shape[1])]
    return lambda unit: np.where(top == unit, second, largest)


def change_levels(form: Form, responses: Array, found: Distances, freqs_hz: Array) -> Array:
    """Return levels, dB, of residuals between units and themselves with one entry changed by one percent: the median over units, shape (p, m, frequency)."""
    G = responses[np.unique(np.linspace(0, len(responses) - 1, min(_MOST, len(responses))).round().astype(int))]
    levels = np.empty((*G.shape[2:], G.shape[1]))
    for i, j in np.ndindex(*G.shape[2:]):
        changed = G.copy()
        changed[:, :, i, j] *= 1 + _PERCENT / 100
        levels[i, j] = np.median(scaled_levels(form, G, changed, found, freqs_hz), axis=0)
    return levels


def smallest_change(change: Array, cover: Array, bound_db: float) -> tuple[float, int, tuple[int, int]]:
    """Return the smallest change of gain that exceeds a cover by a bound, percent, its frequency and entry; infinity, and the first, without a bound."""
    if not np.isfinite(bound_db):
        return float("inf"), 0, (0, 0)
    percent = _PERCENT * 10 ** ((cover + bound_db - change) / 20)
    i, j, row = (int(k) for k in np.unravel_index(int(np.argmin(percent)), percent.shape))
    return float(percent[i, j, row]), row, (i, j)
