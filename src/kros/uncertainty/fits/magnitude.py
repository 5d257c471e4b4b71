r"""Log-Chebyshev fit of a magnitude by a stable, minimum-phase system from above.

Of all squared magnitudes `n / d` of one order with `m^2 <= n / d <= gamma m^2` on the grid, the one with the smallest `gamma` is found:
a quasi-convex problem, solved by a handful of linear programs (`minimax`). After every program the true ratios are recomputed, `n` is lifted
by the deficit, and both are proven positive on the whole axis by the location of their roots.

Basis and spectral factor: see `spectral`. In `tau = tan^2(theta / 2)` the fit holds its precision over six decades and more.
"""

from __future__ import annotations

import logging
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Any

import numpy as np
import numpy.typing as npt

from ...core.errors import ConfigError, DataError, DimensionError, KrosError
from ...core.frequency import bilinear_squared, check_grid
from ...core.lti import StateSpace, gain
from .minimax import Grid, Programs
from .spectral import RationalMagnitude, basis, log_knots, on_half_line, roots, spectral_factor

Array = npt.NDArray[Any]

_LOG = logging.getLogger(__name__)
_FLOOR = 1e-8  # magnitudes below this fraction of the largest count as this fraction (-160 dB)
_POINTS = 150  # of the grid in the first programs
_ROUNDS = 6
_PROGRAMS = (
    150  # for one order, half as many while a higher one is allowed; more than 200 were never seen to gain anything
)
_EXCHANGE = 10**0.002 - 1  # 0.02 dB of squared magnitude
_HOPELESS = 2.0  # an order whose overbound is beyond this many tolerances is not polished while a higher one is allowed
_UNPROVEN_DB = 0.5  # a fit farther than this from what is proven to be the best is compared with those that start from lower orders
_HALVINGS, _BOTTOMS = 30, 25  # of the search for an alternation
_GAIN = 0.9  # a further order that brings the overbound in dB to this share needs no other start


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
        Whether `overbound_db` is within the tolerance asked for.
    proven_db : float, dB
        No system of this order stays closer to the data on the same grid than this.

    Examples
    --------
    >>> import numpy as np
    >>> from kros.uncertainty import fit_magnitude
    >>> freqs_hz = np.geomspace(0.1, 50, 30)
    >>> fitted = fit_magnitude(freqs_hz, 1 / (1 + freqs_hz / 5), 0.01, max_order=2)
    >>> fitted.within_tolerance
    True
    """

    system: StateSpace
    order: int
    overbound_db: float
    within_tolerance: bool
    proven_db: float = float("nan")


def fit_magnitude(
    freqs_hz: npt.ArrayLike,
    magnitude: npt.ArrayLike,
    sample_period_s: float,
    order: int | None = None,
    *,
    min_order: int = 0,
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
        Best fit of at most this order; by default the smallest order within the tolerance, or the best up to `max_order`.
    min_order, max_order : int
        Orders that are tried.
    tolerance_db : float, dB
        Largest distance accepted when the order is chosen.

    Returns
    -------
    FittedMagnitude

    Raises
    ------
    DataError
        Magnitudes negative, NaN or infinite.
    KrosError
        When no program of any order could be solved.

    Notes
    -----
    The bound holds at the given frequencies, for the system as returned and evaluated. Between them the fit is smooth, and positive.

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
    problem = _Problem(freqs, values, sample_period_s)
    best: FittedMagnitude | None = None
    lower: _Bound | None = None
    if order is not None:
        best, _ = problem.fit(order, tolerance_db, None, last=True)
        if best is not None and best.overbound_db < best.proven_db + _UNPROVEN_DB:
            return best
    for candidate in range(min(min_order, highest), highest + 1):
        found, lower = problem.fit(candidate, tolerance_db, lower, last=candidate == highest)
        if found is not None and (best is None or found.overbound_db < best.overbound_db):
            best = found
        if best is not None and best.within_tolerance:
            break
    if best is None:
        raise KrosError(
            f"Magnitude fit: no system of order up to {highest} found for {len(freqs)} points; raise max_order or smooth the data."
        )
    return best


def alternation_db(ratio: npt.ArrayLike, count: int) -> float:
    """Return what no magnitude stays closer to the data than, dB, from a fit's ratio to them (de la Vallee Poussin's bound for ratios)."""
    level = _turning(20 * np.log10(np.asarray(ratio, float)))
    low, high = 0.0, float(np.ptp(level))
    for _ in range(_HALVINGS):
        middle = (low + high) / 2
        bottoms = np.linspace(level.min(), level.max() - middle, _BOTTOMS)
        if (_swings(level, bottoms, bottoms + middle) >= count).any():
            low = middle
        else:
            high = middle
    return low


def _turning(level: Array) -> Array:
    """Return the ends and the values at which a sequence turns: what is between them swings no further."""
    steps = np.diff(level)
    level, steps = level[np.append(True, steps != 0)], steps[steps != 0]
    return level[np.concatenate([[True], steps[1:] * np.sign(steps[:-1]) < 0, [True]])] if len(steps) else level


def _swings(level: Array, bottoms: Array, tops: Array) -> Array:
    """How often the level reaches below every bottom and above its top in turn."""
    side = (level >= tops[:, None]).astype(np.int8) - (level <= bottoms[:, None])
    row, column = side.nonzero()
    side, turned = side[row, column], np.ones(len(row), bool)
    turned[1:] = (side[1:] != side[:-1]) | (row[1:] != row[:-1])
    return np.bincount(row[turned], minlength=len(bottoms))


def invert(system: StateSpace) -> StateSpace:
    """Return the inverse of a square system with a regular feedthrough."""
    D = np.linalg.inv(system.D)
    B = system.B @ D
    return StateSpace(system.A - B @ system.C, B, -D @ system.C, D, system.dt)


def majorant(tau: Array, magnitude: Array, order: int) -> RationalMagnitude | None:
    """Return the best squared magnitude of an order above data at points in tau, none where the programs fail; both shape (n_points,)."""
    targets = np.maximum(magnitude, _FLOOR * magnitude.max()) ** 2
    unit = np.exp(np.mean(np.log(targets)))
    found = _minimax(tau, targets / unit, order, None, np.inf)
    return None if found is None else replace(found.rational, numerator=found.rational.numerator * unit)


@dataclass(frozen=True, eq=False)
class _Problem:
    """Data of one fit, in physical values; the programs work on `targets`."""

    freqs: Array
    values: Array
    dt: float

    def fit(
        self, order: int, tolerance_db: float, lower: _Bound | None, *, last: bool
    ) -> tuple[FittedMagnitude | None, _Bound | None]:
        """Fit one order, starting from the bound of a lower order; None where the programs fail."""
        tau = bilinear_squared(self.freqs, self.dt)
        targets = self.values**2  # to stay above
        unit = float(np.exp(np.mean(np.log(targets))))
        hopeless = np.inf if last else 10 ** (_HOPELESS * tolerance_db / 10)
        found = _minimax(tau, targets / unit, order, lower, hopeless)
        if found is None:
            return None, lower
        try:
            return self._finish(found.rational, unit, tolerance_db), found
        except (
            KrosError
        ) as error:  # positive on the grid and zero at Nyquist: no system with an inverse, another order is
            _LOG.debug("Magnitude fit: order %d has no spectral factor (%s)", order, error)
            return None, lower

    def _finish(self, rational: RationalMagnitude, unit: float, tolerance_db: float) -> FittedMagnitude:
        """Factorise, and lift by the deficit of the system as evaluated."""
        bound = RationalMagnitude(rational.numerator * unit, rational.denominator, rational.knots)
        system = spectral_factor(bound, self.dt)
        ratio = np.abs(system.frequency_response(self.freqs)[:, 0, 0]) / self.values
        if not (ratio.min() > 0 and np.isfinite(ratio).all()):
            raise KrosError(
                "Magnitude fit: the system vanishes or is infinite at a frequency of the grid; try another order."
            )
        touch = (1 + 1e-12) / ratio.min()
        system = StateSpace(system.A, system.B, system.C * touch, system.D * touch, system.dt)
        overbound = float(20 * np.log10(ratio.max() / ratio.min()))
        proven = alternation_db(ratio, 2 * system.n_states + 2)
        return FittedMagnitude(system, system.n_states, overbound, overbound <= tolerance_db, proven)


@dataclass(frozen=True, eq=False)
class _Bound:
    """A bound of the squared targets, with its largest ratio to them."""

    rational: RationalMagnitude
    ratio: float


def _minimax(tau: Array, targets: Array, order: int, lower: _Bound | None, hopeless: float) -> _Bound | None:
    """Best n / d of one order above the targets, positive on the whole axis; `lower` is the best of an order less."""
    if order == 0:
        return _Bound(
            RationalMagnitude(np.array([targets.max()]), np.ones(1), np.zeros(0)), float(targets.max() / targets.min())
        )
    programs = Programs(_PROGRAMS if np.isinf(hopeless) else _PROGRAMS // 2)
    best = _exchange(tau, targets, np.exp(log_knots(tau, np.log(targets), order, 0.05)), lower, hopeless, programs)
    for even in (1.0, 0.3):
        if best is not None and (lower is None or best.ratio < lower.ratio * (1 - 1e-3) or lower.ratio < 1 + _EXCHANGE):
            break
        other = _exchange(tau, targets, np.exp(log_knots(tau, np.log(targets), order, even)), lower, hopeless, programs)
        best = other if best is None or (other is not None and other.ratio < best.ratio) else best
    return best


def _exchange(
    tau: Array, targets: Array, knots: Array, lower: _Bound | None, hopeless: float, programs: Programs
) -> _Bound | None:
    """Solve on part of the grid, and add the points at which the bound found there is worse; a ratio beyond `hopeless` is left as it is."""
    chosen = np.unique(np.linspace(0, len(tau) - 1, _POINTS).round().astype(int))
    cuts = np.zeros(0)
    phi, best = basis(tau, knots), None
    start = None if lower is None else basis(tau, lower.rational.knots) @ lower.rational.denominator
    enough = 1 + _EXCHANGE if lower is None else max(lower.ratio**_GAIN, 1 + _EXCHANGE)
    for _ in range(_ROUNDS):
        starts = [targets[chosen] ** -0.5] if best is None else []  # n and d share the slope
        if start is not None:
            starts.append(start[chosen])
        if best is None:
            starts.append(np.ones(len(chosen)))
        rational = Grid.build(tau[chosen], targets[chosen], knots, cuts, programs).best(starts, enough)
        if rational is None:
            return best
        n, d = phi @ rational.numerator, phi @ rational.denominator
        ratio = np.where((n > 0) & (d > 0), n / (targets * np.where(d > 0, d, 1.0)), 0.0)
        try:
            bad = sorted(
                on_half_line(roots(rational.numerator, knots)[0]) + on_half_line(roots(rational.denominator, knots)[0])
            )
        except KrosError as error:  # multiple roots: this order is left to what was found before
            _LOG.debug("Magnitude fit: %s", error)
            return best
        if not bad and ratio.min() > 0 and (best is None or ratio.max() / ratio.min() < best.ratio):
            best, start = (
                _Bound(
                    RationalMagnitude(rational.numerator / ratio.min(), rational.denominator, knots),
                    float(ratio.max() / ratio.min()),
                ),
                d,
            )
        worse = np.setdiff1d(_extremes(ratio, 1.0, float(ratio[chosen].max())), chosen)
        if not bad and (not worse.size or (best is not None and best.ratio > hopeless)):
            break
        chosen = np.union1d(chosen, worse)
        cuts = np.unique(np.concatenate([cuts, bad, [np.sqrt(x * y) for x, y in pairwise(bad)]]))
    return best


def _extremes(ratio: Array, low: float, high: float) -> Array:
    """Indices of local extremes of the ratio that leave [low, high] by more than 0.01 dB."""
    inner = np.concatenate([[ratio[0]], ratio, [ratio[-1]]])
    dips = (ratio <= inner[:-2]) & (ratio <= inner[2:]) & (ratio < low * (1 - _EXCHANGE))
    peaks = (ratio >= inner[:-2]) & (ratio >= inner[2:]) & (ratio > high * (1 + _EXCHANGE))
    return np.flatnonzero(dips | peaks)


def _check_magnitude(magnitude: npt.ArrayLike, freqs: Array) -> Array:
    """Return magnitudes with a relative floor."""
    values = np.asarray(magnitude, float)
    if values.shape != freqs.shape:
        raise DimensionError(
            f"Magnitude fit: needs one magnitude for each of {len(freqs)} frequencies, found shape {values.shape}."
        )
    if not (np.isfinite(values) & (values >= 0)).all():
        where = int(np.argmin(np.isfinite(values) & (values >= 0)))
        raise DataError(
            f"Magnitude fit: magnitudes should be finite and not negative, found {values[where]} at {freqs[where]} Hz; look at the responses."
        )
    return np.maximum(values, _FLOOR * values.max())
