"""What is said about one unit: how far it exceeds the others, and what would have been seen had it differed.

A score below the threshold means little by itself. Beside it stands what the unit would have to differ by to be
flagged; where that is more than anybody would call a defect, nothing is said about the unit instead of "ok".
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, fields
from enum import StrEnum
from typing import Any

import numpy as np

# below, the verdict on a unit is left open: of studies of five up to a third of the good units were beyond a bound
FEWEST_UNITS = 8
LARGEST_DB = 26.0  # beyond the largest of the others: twenty times as far away as any of them is
LARGEST_PERCENT = 900.0  # change of gain: ten times as large


class Status(StrEnum):
    """What the recordings say about a unit.

    ``ok``: a change of the size that stands beside it would have been flagged. ``outlier``: flagged. ``not enough
    data``: too few recordings of this unit. ``cannot tell``: fewer than eight units to compare with, or too unlike
    ones. ``other motions``: beyond the others, but by no more than one unit differs from motion to motion, and its
    motions are none of theirs.
    """

    OK = "ok"
    OUTLIER = "outlier"
    NOT_ENOUGH_DATA = "not enough data"
    CANNOT_TELL = "cannot tell"
    OTHER_MOTIONS = "other motions"


@dataclass(frozen=True)
class OutlierScore:
    """How far one unit exceeds the others.

    Parameters
    ----------
    unit : str
    score_db : float, dB
        The excess, referred to the threshold: the thresholds of units that went out earlier in the search differ, and
        the difference is added to their excess, so that one threshold serves all units.
    threshold_db : float, dB
    outlier : bool
    freq_hz : float, Hz
        Where the unit's level is largest.
    entry : tuple of int
        Row and column of the residual's largest entry there, relative to its typical size.
    excess_db : float, dB
        What the unit's largest level has beyond the largest of the other inliers; negative for all units but one
        inlier.
    lowest_db, highest_db : float, dB
        Range of the excess over all choices of one nominal unit.
    status : Status
    detectable_db : float, dB
        What the excess would have to be for the unit to be flagged; infinite where nothing could be.
    detectable_percent : float
        Smallest change of gain of one entry of the response that is an excess of that size somewhere, to first order.
    detectable_hz : float, Hz, or None
        Where that is; None where `detectable_percent` is infinite.
    detectable_entry : tuple of int
        Output and input of the entry.
    more_data : float
        How many times as long the unit would have to be recorded; one where the recordings suffice.

    Examples
    --------
    >>> import numpy as np
    >>> from kros.uncertainty import score_outliers
    >>> rng, freqs_hz = np.random.default_rng(0), np.geomspace(0.1, 40, 20)
    >>> gains, corners_hz = 1 + 0.02 * rng.normal(size=20), 5 + 0.2 * rng.normal(size=20)
    >>> responses = gains[:, None] / (1 + 1j * freqs_hz / corners_hz[:, None])
    >>> score = score_outliers(responses[:, :, None, None], freqs_hz).scores[0]
    >>> score.unit, score.score_db < score.threshold_db, score.outlier
    ('0', True, False)
    """

    unit: str
    score_db: float
    threshold_db: float
    outlier: bool
    freq_hz: float
    entry: tuple[int, int]
    excess_db: float
    lowest_db: float
    highest_db: float
    status: Status = Status.CANNOT_TELL
    detectable_db: float = float("inf")
    detectable_percent: float = float("inf")
    detectable_hz: float | None = None
    detectable_entry: tuple[int, int] = (0, 0)
    more_data: float = 1.0

    @classmethod
    def from_content(cls, content: Mapping[str, Any], threshold_db: float) -> OutlierScore:
        """Return a score as it was before it became JSON, which knows neither infinity nor tuples."""
        values: dict[str, Any] = {f.name: content[f.name] for f in fields(cls)}
        unknown = [name for name, value in values.items() if value is None and name != "detectable_hz"]
        values |= dict.fromkeys(unknown, float("inf"))
        values |= {name: tuple(content[name]) for name in ("entry", "detectable_entry")}
        return cls(**values | {"threshold_db": threshold_db, "status": Status(content["status"])})


def room_db(detectable_db: float, detectable_percent: float) -> float:
    """Return by how much a bound could be higher before the absence of an alarm means nothing, dB."""
    if not (np.isfinite(detectable_db) and np.isfinite(detectable_percent)):
        return float("-inf")
    return float(
        min(LARGEST_DB - detectable_db, 20 * np.log10(LARGEST_PERCENT / max(detectable_percent, np.finfo(float).tiny)))
    )
