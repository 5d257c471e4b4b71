"""What a synthesis returns: the correction filter K, what happened, and the numbers that were recomputed."""

from __future__ import annotations

import logging
from enum import Enum

from ..core import AGREED, Names, StateSpace, Storable, frozen

log = logging.getLogger(__name__)


class Injection(str, Enum):
    """Where the correction enters the observer.

    INPUT
        ``x_hat+ = A x_hat + B (u + K (y - C x_hat))``, as in the paper (20).
    STATE
        ``x_hat+ = A x_hat + B u + K (y - C x_hat)``.
    NONE
        The controller belongs to a general plant, not to an observer.

    Examples
    --------
    >>> from kros.synthesis import Injection
    >>> Injection("state") is Injection.STATE
    True
    """

    INPUT = "input"
    STATE = "state"
    NONE = "none"


class Status(str, Enum):
    """What happened, and what to change.

    OPTIMAL
        The optimum of the stated problem, verified: norms recomputed, loop stable.
    CERTIFIED
        Verified and its guarantee recomputed; the distance to the optimum is at most `gap_percent` (where it is known).
    INACCURATE
        The solver stopped early, but its result passed the same verification. Raise its number of steps, or add
        measurement noise and penalty, to come closer to the optimum.

    Examples
    --------
    >>> from kros.synthesis import Status, kalman
    >>> kalman([[1.0]], [[1.0]], [[1.0]], [[2.0]]).status is Status.OPTIMAL
    True
    """

    OPTIMAL = "optimal"
    CERTIFIED = "certified"
    INACCURATE = "inaccurate"


@frozen
class Synthesis(Storable):
    """A verified correction filter and its certificate.

    Examples
    --------
    >>> from kros.synthesis import kalman
    >>> found = kalman([[1.0]], [[1.0]], [[1.0]], [[2.0]])
    >>> found.method, found.status.value, round(found.spectral_radius, 6)
    ('kalman', 'optimal', 0.5)
    """

    KIND = "synthesis"
    method: str  # for example ``worst_case_h2``
    controller: StateSpace  # ``u = K y`` (positive feedback); for observers ``y`` is the innovation ``y - C x_hat``
    status: Status
    injection: Injection = Injection.NONE
    h2_norm: float | None = None  # of the closed loop from w (or w1) to z (or z1), recomputed
    hinf_norm: float | None = None  # of the closed loop from w (or w2) to z (or z2), recomputed
    worst_case_h2: float | None = None  # certified for every member of the uncertain set
    lower_bound: float | None = None  # no controller of this kind does better
    gap_percent: float | None = None  # ``100 (value / lower_bound - 1)``
    spectral_radius: float | None = None  # of the nominal loop (continuous: the largest real part)
    notes: Names = ()


def enclosed(value: float, lower: float | None) -> tuple[float | None, float | None, Names]:
    """Return the lower bound of an attained value, their distance in percent, and notes."""
    if value == 0 or lower == 0:
        return 0.0, None, ()
    if lower is None:
        return None, None, ("No lower bound could be proven.",)
    if lower > value * (1 + AGREED):
        problem = f"a lower bound of {lower:.9g} above the attained {value:.9g} was dropped"
        log.error("Internal error: %s", problem)
        return None, None, (f"Internal error: {problem}; please report this problem.",)
    lower = min(lower, value)
    return lower, 100 * (value / lower - 1), ()
