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
from .programs import Grid
from .rational import RationalMagnitude, basis
from .sections import Sections

Array = npt.NDArray[Any]

_FLOOR = 1e-8  # magnitudes below this fraction of the largest count as this fraction (-160 dB)
_LOG = logging.getLogger(__name__)
_TOP = 10.0  # tau (80 % of Nyquist) beyond which there are no knots
_POINTS, _ROUNDS = 150, 6  # of the grid of the first programs; further points join until the whole grid agrees
_EVEN = (0.05, 1.0, 0.3)  # shares of knots that are evenly spaced, where the one before brings nothing
_EXACT = 10**1e-5  # ratio of squared magnitudes, 1e-4 dB, that a higher order need not better
_SAME = 10**0.002  # ratio of squared magnitudes, 0.02 dB, up to which extremes of the whole grid agree


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
    tau, unit = bilinear_squared(freqs, sample_period_s), float(np.exp(np.mean(np.log(values))))
    best: FittedMagnitude | None = None
    for bound in _bounds(tau, values / unit, highest):
        fitted = _factored(bound.rational, freqs, values / unit, sample_period_s)
        if fitted is not None and (best is None or fitted[1] < best.overbound_db):
            system, overbound_db = fitted
            system = StateSpace(system.A, system.B, system.C * unit, system.D * unit, system.dt)
            best = FittedMagnitude(system, system.n_states, overbound_db, overbound_db <= tolerance_db)
        if order is None and best is not None and best.within_tolerance:
            break
    if best is None:
        raise KrosError(
            f"Magnitude fit: no system of order up to {highest} fits {len(freqs)} points; raise the order or smooth "
            "the data."
        )
    return best


def best_sections(tau: Array, magnitude: Array, max_order: int) -> Sections:
    """Return the tightest bound of positive magnitudes at increasing tau, of the order or a lower one that is exact."""
    values = np.maximum(magnitude, _FLOOR * magnitude.max())
    unit = float(np.exp(np.mean(np.log(values))))
    best: Sections | None = None
    for bound in _bounds(tau, values / unit, max_order):
        try:
            best = bound.rational.factor()
        except KrosError as error:
            _LOG.debug("Magnitude fit: %s", error)
    if best is None:
        raise KrosError(f"Magnitude fit: no bound of order up to {max_order} for {len(tau)} points; raise max_order.")
    return best.lifted(slice(0, 1), float(np.log(unit)))


def _bounds(tau: Array, values: Array, max_order: int) -> Iterator[_Bound]:
    """Yield bounds of rising orders, each better than those before, until one is exact."""
    lower: _Bound | None = None
    for order in range(max_order + 1):
        bound = _best_bound(tau, values**2, order, lower)
        if bound is not None and (lower is None or bound.ratio < lower.ratio):
            lower = bound
            yield bound
            if bound.ratio < _EXACT:
                break


@dataclass(frozen=True, eq=False)
class _Bound:
    """A bound of the squared targets, with its largest ratio to them."""

    rational: RationalMagnitude
    ratio: float


def _factored(rational: RationalMagnitude, freqs: Array, values: Array, dt: float) -> tuple[StateSpace, float] | None:
    """Return the system, lifted by the deficit as evaluated, and its overbound, dB; None where it has no inverse."""
    try:
        (system,) = rational.factor().systems(dt)
    except KrosError as error:
        _LOG.debug("Magnitude fit: %s", error)
        return None
    ratio = np.abs(system.frequency_response(freqs)[:, 0, 0]) / values
    if not (ratio.min() > 0 and np.isfinite(ratio).all()):
        return None
    touch = (1 + 1e-12) / ratio.min()
    lifted = StateSpace(system.A, system.B, system.C * touch, system.D * touch, dt)
    return lifted, float(20 * np.log10(ratio.max() / ratio.min()))


def _best_bound(tau: Array, targets: Array, order: int, lower: _Bound | None) -> _Bound | None:
    """Return the best n / d of one order above the targets, positive on the whole axis."""
    if order == 0:
        rational = RationalMagnitude(np.array([targets.max()]), np.ones(1), np.zeros(0))
        return _Bound(rational, float(targets.max() / targets.min()))
    best = None
    for even in _EVEN:
        knots = np.exp(_bends(tau, np.log(targets), order, even))
        other = _exchanged(tau, targets, knots, lower)
        if best is None or (other is not None and other.ratio < best.ratio):
            best = other
        if best is not None and (lower is None or best.ratio < lower.ratio * (1 - 1e-3)):
            break
    return best


def _exchanged(tau: Array, targets: Array, knots: Array, lower: _Bound | None) -> _Bound | None:
    """Solve on part of the grid, and add the points at which the bound is worse."""
    chosen = np.unique(np.linspace(0, len(tau) - 1, _POINTS).round().astype(int))
    phi, cuts, best = basis(tau, knots), np.zeros(0), None
    starts = [targets**-0.5, np.ones(len(tau))]  # n and d share the slope
    if lower is not None:
        starts.append(basis(tau, lower.rational.knots) @ lower.rational.denominator)
    for _ in range(_ROUNDS):
        rational = Grid.of(tau[chosen], targets[chosen], knots, cuts).best([start[chosen] for start in starts])
        if rational is None:
            break
        n, d = phi @ rational.numerator, phi @ rational.denominator
        ratio = np.where((n > 0) & (d > 0), n / (targets * np.where(d > 0, d, 1.0)), 0.0)
        try:
            bad = rational.not_positive()
        except KrosError as error:  # multiple roots: this order is left to what was reached before
            _LOG.debug("Magnitude fit: %s", error)
            break
        spread = float(ratio.max() / ratio.min()) if ratio.min() > 0 else np.inf
        if not bad and (best is None or spread < best.ratio):
            lifted = RationalMagnitude(rational.numerator / ratio.min(), rational.denominator, knots)
            best, starts = _Bound(lifted, spread), [d]
        worse = np.setdiff1d(_extremes(ratio, float(ratio[chosen].max())), chosen)
        if not bad and not worse.size:
            break
        chosen = np.union1d(chosen, worse)
        cuts = np.unique(np.concatenate([cuts, bad, [np.sqrt(x * y) for x, y in pairwise(bad)]]))
    return best if best is not None and np.isfinite(best.ratio) else None


def _bends(tau: Array, log: Array, count: int, even: float) -> Array:
    """Return log tau, shape (count,), as dense as log magnitudes bend over log tau, plus a share evenly spaced."""
    inside = (tau > 0) & (tau < _TOP)
    if inside.sum() < 3:
        return np.linspace(-_TOP, 0.0, count + 2)[1:-1]
    x = np.log(tau[inside])
    middle = (x[1:] + x[:-1]) / 2
    bend = np.concatenate([[0.0], np.cumsum(np.abs(np.diff(np.diff(log[inside]) / np.diff(x))))])
    bend = bend / bend[-1] if bend[-1] > 0 else bend
    share = (1 - even) * bend + even * (middle - middle[0]) / (middle[-1] - middle[0])
    return np.interp((np.arange(count) + 0.5) / count * share[-1], share, middle)


def _extremes(ratio: Array, high: float) -> Array:
    """Return the indices of local extremes of the ratio that leave [1, high]."""
    inner = np.concatenate([[ratio[0]], ratio, [ratio[-1]]])
    dips = (ratio <= inner[:-2]) & (ratio <= inner[2:]) & (ratio < 1 / _SAME)
    peaks = (ratio >= inner[:-2]) & (ratio >= inner[2:]) & (ratio > high * _SAME)
    return np.flatnonzero(dips | peaks)


def _check_magnitude(magnitude: npt.ArrayLike, freqs: Array) -> Array:
    """Return magnitudes with a relative floor."""
    values = np.asarray(magnitude, float)
    if values.shape != freqs.shape:
        raise DimensionError(
            f"Magnitude fit: needs one magnitude for each of {len(freqs)} frequencies, found shape {values.shape}."
        )
    valid = np.isfinite(values) & (values >= 0)
    if not valid.all():
        where = int(np.argmin(valid))
        raise DataError(
            f"Magnitude fit: magnitudes should be finite and not negative, found {values[where]} at {freqs[where]} Hz; "
            "look at the responses."
        )
    return np.maximum(values, _FLOOR * values.max())
