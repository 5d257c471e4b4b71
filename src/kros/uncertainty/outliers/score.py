r"""What is said about one unit: how far it exceeds the others, and what would have been seen had it differed.

Beside a score stands what the unit would have to differ by to be flagged; where that is more than a defect would be,
nothing is said about the unit instead of "ok".
"""

from bisect import bisect_left
from dataclasses import dataclass, replace
from enum import StrEnum
from functools import cached_property

import numpy as np

from ...core import AnyArray, Flags, Names, frozen
from ..forms import Form, evenly
from ..settings import OUTLIER
from .distances import Distances, scaled_levels
from .tail import excesses, factor

# below, the verdict on a unit is left open: of studies of five up to a third of the good units were beyond a bound
FEWEST_UNITS = OUTLIER.fewest


class Status(StrEnum):
    """What the recordings say about a unit.

    ``ok``: a change of the size that stands beside it would have been flagged. ``outlier``: flagged. ``not enough
    data``: too few recordings of this unit. ``cannot tell``: too few units to compare with, or too unlike ones.
    ``other motions``: beyond the others, but by no more than one unit differs from motion to motion, and its motions
    are none of theirs.
    """

    OK = "ok"
    OUTLIER = "outlier"
    NOT_ENOUGH_DATA = "not enough data"
    CANNOT_TELL = "cannot tell"
    OTHER_MOTIONS = "other motions"


@dataclass(frozen=True)
class OutlierScore:
    """How far one unit exceeds the others.

    The thresholds of units that went out earlier in the search differ; the difference is added to their excess, so that
    one threshold serves all units.
    """

    unit: str
    score_db: float  # the excess, referred to the threshold
    threshold_db: float
    outlier: bool
    freq_hz: float  # where the unit's level is largest
    excess_db: float  # of the largest level over that of the other inliers; negative for all units but one inlier
    lowest_db: float  # range of the excess over all choices of one nominal unit
    highest_db: float
    status: Status = Status.CANNOT_TELL
    detectable_percent: tuple[float, ...] = ()  # of each output: smallest change of its gain that would be flagged
    more_data: float = 1.0  # how many times as long the unit would have to be recorded; one where recordings suffice
    fewest_units: int | None = None  # that would decide, were they as unlike as these; none where no number would


@frozen
class Comparison:
    """Units and their distances; units are scored against the inliers among them.

    Beside a score stands the smallest change of each output's gain that it would have shown. An output that is one
    percent larger is a residual of some level at every frequency; a level is proportional to the change to first
    order, so what it takes to reach the bound follows in percent.
    """

    form: Form
    responses: AnyArray  # (unit, frequency, p, m), scaled
    freqs_hz: AnyArray
    distances: Distances
    inliers: Flags
    rate: float  # of false alarms

    def scores(self, ids: Names, threshold: float, margin_db: AnyArray) -> tuple[OutlierScore, ...]:
        """Return scores of the last units, whose names and margins are given."""
        levels, scores = self.distances.levels, []
        excess, by_nominal = (excesses(v, self.inliers) for v in (levels.max(axis=1), self.distances.peaks))
        ends = np.array([np.nanmin(by_nominal, axis=0), np.nanmax(by_nominal, axis=0)]).T.tolist()
        known = bool(np.isfinite(threshold))
        for unit, (name, margin) in enumerate(zip(ids, margin_db.tolist(), strict=True), len(levels) - len(ids)):
            value = float(excess[unit])
            score_db = threshold + margin if known else value
            beyond, hz = known and margin > 0, float(self.freqs_hz[levels[unit].argmax()])
            score = OutlierScore(name, score_db, threshold, beyond, hz, value, *ends[unit])
            scores.append(self._detectable(score, unit, value - margin))
        return tuple(scores)

    def _detectable(self, score: OutlierScore, unit: int, bound_db: float) -> OutlierScore:
        """Return a score with the smallest changes of gains that are an excess of the bound, and what follows."""
        cover = float(self.distances.levels[unit].max()) - score.excess_db
        percent = OUTLIER.percent * 10 ** ((cover + bound_db - self._changes) / 20)
        largest = min(OUTLIER.largest_db, bound_db + 20 * np.log10(OUTLIER.largest_percent / percent.min()))
        share = factor(int(self.inliers.sum() - self.inliers[unit]), self.rate) * largest / bound_db
        enough = OUTLIER.fewest + bisect_left(
            range(OUTLIER.fewest, int(1 / self.rate)), True, key=lambda n: factor(n, self.rate) <= share
        )
        score = replace(score, fewest_units=enough if share >= 0 else None)
        if not np.isfinite(score.threshold_db):
            return score
        inlier = Status.OK if bound_db <= largest else Status.CANNOT_TELL
        status = Status.OUTLIER if score.outlier else inlier
        return replace(score, status=status, detectable_percent=tuple(percent.tolist()))

    @cached_property
    def _changes(self) -> AnyArray:
        """Largest levels, dB, of residuals between inliers and themselves with one output changed, shape (p,)."""
        G = self.responses[self.inliers]
        G = G[evenly(len(G), OUTLIER.changed)]
        rows = 1 + OUTLIER.percent / 100 * np.eye(G.shape[2])
        levels = [scaled_levels(self.form, G, G * row[:, None], self.distances, self.freqs_hz) for row in rows]
        return np.median(levels, axis=1).max(axis=1)
