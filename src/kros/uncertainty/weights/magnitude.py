r"""Log-Chebyshev fit of one magnitude by a stable, minimum-phase system from above.

Of all squared magnitudes `n / d` of one order with `m^2 <= n / d <= gamma m^2` on the grid, the one with the smallest
`gamma` is found: a quasi-convex problem, solved by a handful of linear programs (`programs`). After every program the
true ratios are recomputed, `n` is lifted by the deficit, and both are proven positive on the whole axis by the location
of their roots. In `tau = tan^2(theta / 2)` the fit holds its precision over six decades and more (`rational`).
"""

from __future__ import annotations

import logging
from collections.abc import Iterator
from dataclasses import dataclass
from itertools import pairwise
from typing import Any

import numpy as np
import numpy.typing as npt

from ...core.errors import ConfigError, DataError, DimensionError, KrosError
from ...core.frequency import bilinear_squared, check_grid
from ...core.lti import StateSpace, gain
from ..settings import MAGNITUDE
from .programs import Grid
from .rational import RationalMagnitude
from .sections import Sections

Array = npt.NDArray[Any]

_LOG = logging.getLogger(__name__)


@dataclass(frozen=True, eq=False)
class FittedMagnitude:
    """A system whose magnitude bounds data.

    Parameters
    ----------
    system : StateSpace
        One input, one output, stable and minimum phase.
    order : int
    overbound_db : float, dB
        Largest distance between the system's magnitude and the data; the smallest is zero.
    within_tolerance : bool
        Whether `overbound_db` is within the tolerance.

    Examples
    --------
    >>> import numpy as np
    >>> from kros.uncertainty import fit_magnitude
    >>> freqs_hz = np.geomspace(0.1, 50, 30)
    >>> fit_magnitude(freqs_hz, 1 / (1 + freqs_hz / 5), 0.01, max_order=2).within_tolerance
    True
    """

    system: StateSpace
    order: int
    overbound_db: float
    within_tolerance: bool


def fit_magnitude(
    freqs_hz: npt.ArrayLike,
    magnitude: npt.ArrayLike,
    sample_period_s: float,
    order: int | None = None,
    *,
    max_order: int = 4,
    tolerance_db: float = 1.0,
) -> FittedMagnitude:
    r"""Return a discrete system whose magnitude is the tightest uniform bound of the data.

    Parameters
    ----------
    freqs_hz : array_like, shape (n_freqs,), Hz
        Increasing, from zero at least to Nyquist at most; both ends allowed.
    magnitude : array_like, shape (n_freqs,)
        Non-negative. Values below 1e-8 of the largest count as that; all zero gives the zero system.
    sample_period_s : float, s
    order : int, optional
        Best fit of at most this order; by default the smallest order within the tolerance, or the best up to
        `max_order`.
    max_order : int
    tolerance_db : float, dB
        Distance at which a lower order is good enough.

    Returns
    -------
    FittedMagnitude

    Raises
    ------
    DataError
        Magnitudes negative, NaN or infinite.
    ConfigError
        A negative order, or frequencies that are no grid.
    KrosError
        When no program of any order could be solved.

    Notes
    -----
    The bound holds at the given frequencies, for the system as returned. Between them the fit is smooth, and positive.

    Examples
    --------
    >>> import numpy as np
    >>> from kros.uncertainty import fit_magnitude
    >>> freqs = np.geomspace(1e-3, 500.0, 200)
    >>> fit = fit_magnitude(freqs, 1 / np.hypot(1.0, freqs / 3.0) + 0.01, 1e-3)
    >>> gain_at_freqs = abs(fit.system.frequency_response(freqs)[:, 0, 0])
    >>> bool(np.all(gain_at_freqs >= 1 / np.hypot(1.0, freqs / 3.0) + 0.01))
    True
    """
    freqs = check_grid(freqs_hz, sample_period_s)
    values = _check_magnitude(magnitude, freqs)
    highest = max_order if order is None else order
    if highest < 0:
        raise ConfigError(f"Magnitude fit: orders should not be negative, found order {order}, max_order {max_order}.")
    if not values.any():
        return FittedMagnitude(gain([[0.0]], sample_period_s), 0, 0.0, True)
    tau, best = bilinear_squared(freqs, sample_period_s), None
    for bound in rising_bounds(tau, values, highest):
        fitted = _touching(bound, freqs, values, sample_period_s, tolerance_db)
        if best is None or fitted.overbound_db < best.overbound_db:
            best = fitted
        if order is None and best.within_tolerance:
            break
    if best is None:
        problem = f"Magnitude fit: no system of order up to {highest} fits {len(freqs)} points"
        raise KrosError(f"{problem}; raise the order or smooth the data.")
    return best


@dataclass(frozen=True, eq=False)
class Bound:
    """A bound of magnitudes on a grid, and how far above them it is at most, dB."""

    order: int
    sections: Sections
    excess_db: float


def rising_bounds(tau: Array, magnitude: Array, max_order: int) -> Iterator[Bound]:
    """Yield the tightest bounds of positive magnitudes at increasing tau, each better than those before."""
    values = np.maximum(magnitude, MAGNITUDE.floor * magnitude.max())
    unit = float(np.exp(np.mean(np.log(values))))
    targets, lower = (values / unit) ** 2, None
    for order in range(max_order + 1):
        best = _best(tau, targets, order, lower)
        if best is None:
            continue
        lower, ratio = best, float((best(tau) / targets).max())
        try:
            sections = best.factor().lifted(slice(0, 1), float(np.log(unit)))
        except KrosError as error:
            _LOG.debug("Magnitude fit: %s", error)
            continue
        yield Bound(order, sections, 10 * float(np.log10(ratio)))
        if ratio < MAGNITUDE.exact:
            break


def _touching(bound: Bound, freqs: Array, values: Array, dt: float, tolerance_db: float) -> FittedMagnitude:
    """Return the system of a bound, scaled until it touches the values as evaluated."""
    (system,) = bound.sections.systems(dt)
    ratio = np.abs(system.frequency_response(freqs)[:, 0, 0]) / values
    touch, overbound_db = (1 + 1e-12) / ratio.min(), float(20 * np.log10(ratio.max() / ratio.min()))
    lifted = StateSpace(system.A, system.B, system.C * touch, system.D * touch, dt)
    return FittedMagnitude(lifted, system.n_states, overbound_db, overbound_db <= tolerance_db)


def _best(tau: Array, targets: Array, order: int, lower: RationalMagnitude | None) -> RationalMagnitude | None:
    """Return the best n / d of one order above the targets, positive on the whole axis, better than a lower one."""
    if lower is None:
        return RationalMagnitude(np.array([targets.max()]), np.ones(1), np.zeros(0))
    knots, cuts = np.exp(_bends(tau, np.log(targets), order)), np.zeros(0)
    gamma = float((lower(tau) / targets).max())
    for _ in range(MAGNITUDE.rounds):
        best = Grid.of(tau, targets, knots, cuts).best(targets**-0.5, gamma)  # n and d share the slope
        try:
            zeros = best.not_positive() if best is not None else []
        except KrosError as error:  # multiple roots
            _LOG.debug("Magnitude fit: %s", error)
            return None
        if not zeros:
            return best
        cuts = np.unique(np.concatenate([cuts, zeros, [np.sqrt(x * y) for x, y in pairwise(zeros)]]))
    return None


def _bends(tau: Array, log: Array, count: int) -> Array:
    """Return log tau, shape (count,), as dense as log magnitudes bend over log tau, plus a share evenly spaced."""
    inside = (tau > 0) & (tau < MAGNITUDE.highest)
    if inside.sum() < 3:
        return np.linspace(-MAGNITUDE.highest, 0.0, count + 2)[1:-1]
    x = np.log(tau[inside])
    middle = (x[1:] + x[:-1]) / 2
    bend = np.concatenate([[0.0], np.cumsum(np.abs(np.diff(np.diff(log[inside]) / np.diff(x))))])
    bend = bend / bend[-1] if bend[-1] > 0 else bend
    share = (1 - MAGNITUDE.even) * bend + MAGNITUDE.even * (middle - middle[0]) / (middle[-1] - middle[0])
    return np.interp((np.arange(count) + 0.5) / count * share[-1], share, middle)


def _check_magnitude(magnitude: npt.ArrayLike, freqs: Array) -> Array:
    """Return magnitudes with a relative floor."""
    values = np.asarray(magnitude, float)
    if values.shape != freqs.shape:
        raise DimensionError(
            f"Magnitude fit: needs a magnitude at each of {len(freqs)} frequencies, found {values.shape}."
        )
    valid = np.isfinite(values) & (values >= 0)
    if not valid.all():
        where = int(np.argmin(valid))
        problem = "Magnitude fit: magnitudes should be finite and not negative"
        raise DataError(f"{problem}, found {values[where]} at {freqs[where]} Hz; look at the responses.")
    return np.maximum(values, MAGNITUDE.floor * values.max())
