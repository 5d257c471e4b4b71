"""Scores of units from distances: who covers whom, and what a unit exceeds that by.

Beside a score stands the smallest change of a unit that it would have shown, as a change of gain: a level in dB says
little to people who build machines. One entry of a unit's response, changed by one percent, is a residual of some level
at every frequency; a level is proportional to the change to first order, so what it takes to reach the bound follows in
percent.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from ..forms import Form
from .distances import Distances, largest_entries, scaled_levels
from .score import OutlierScore, Status, room_db
from .separation import covers, margins

Array = npt.NDArray[Any]

_PERCENT = 1.0
_MOST = 12  # units whose changes are tried


@dataclass(frozen=True, eq=False)
class Nominals:
    """Excess of every unit with one nominal at a time, shape (nominal, unit)."""

    excess_db: Array
    beyond: Array

    @classmethod
    def of(cls, found: Distances, inliers: npt.NDArray[np.bool_], rate: float) -> Nominals:
        """Score all units against the inliers under every nominal."""
        shape = found.by_nominal.shape[:2]
        values, beyond = np.full(shape, np.nan), np.zeros(shape, bool)
        for row, nominal in enumerate(found.nominals):
            others = np.arange(shape[1]) != nominal
            values[row, others], margin = margins(found.by_nominal[row, others], inliers[others], rate)
            beyond[row, others] = margin > 0
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
    rows = found.levels[list(units)].argmax(axis=1)
    entries = largest_entries(form, G, found, np.asarray(units), rows)
    change = change_levels(form, G[inliers], found, freqs)
    cover = covers(found.levels, inliers)
    value = found.levels.max(axis=1) - cover
    scores = []
    for k, unit, margin, row, entry in zip(units, ids, margins, rows, entries, strict=True):
        known = np.isfinite(threshold) and np.isfinite(margin)
        referred = threshold + margin if known else float(value[k])
        beyond = bool(np.isfinite(threshold) and margin > 0)
        bound = float(value[k]) - margin if known else float("inf")
        percent, at, changed = smallest_change(change, float(cover[k]), bound)
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


def change_levels(form: Form, responses: Array, found: Distances, freqs_hz: Array) -> Array:
    """Return levels, dB, of residuals between units and themselves with one entry changed by one percent."""
    G = responses[np.unique(np.linspace(0, len(responses) - 1, min(_MOST, len(responses))).round().astype(int))]
    levels = np.empty((*G.shape[2:], G.shape[1]))
    for i, j in np.ndindex(*G.shape[2:]):
        changed = G.copy()
        changed[:, :, i, j] *= 1 + _PERCENT / 100
        levels[i, j] = np.median(scaled_levels(form, G, changed, found, freqs_hz), axis=0)
    return levels


def smallest_change(change: Array, cover: float, bound_db: float) -> tuple[float, int, tuple[int, int]]:
    """Return the smallest change of gain that exceeds a cover by a bound, percent, its frequency and entry."""
    if not np.isfinite(bound_db):
        return float("inf"), 0, (0, 0)
    percent = _PERCENT * 10 ** ((cover + bound_db - change) / 20)
    i, j, row = (int(k) for k in np.unravel_index(int(np.argmin(percent)), percent.shape))
    return float(percent[i, j, row]), row, (i, j)
