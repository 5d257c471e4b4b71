r"""Log-Chebyshev fit of one magnitude by a stable, minimum-phase system from above.

Of all squared magnitudes `n / d` of one order with `m^2 <= n / d <= gamma m^2` on the grid, the one with the smallest
`gamma` is found: a quasi-convex problem in the coefficients a and b of n and d. With `f = m^2`, the gamma and the
denominator `e` of the step before, Dinkelbach's iteration solves quadratic programs

    minimise sum_i (h_i^2 + below^2 l_i^2)  s.t.  h_i = (gamma d_i - n_i / f_i) / e_i >= const,
                                                  l_i = (n_i / f_i - d_i) / e_i >= 0

Each has a solution of a smaller ratio unless there is none. The iteration converges superlinearly to the global
optimum, from any denominator; of several optima it takes one that is near the data. The objective is the squared norm
of coefficients that are orthonormalised, so that each program is one of nonnegative least squares (Lawson and Hanson).
After every program the true ratios are recomputed, `n` is lifted by the deficit, and both are proven positive on the
whole axis by the location of their roots.

Squared magnitudes are rational in tau:

    n(tau) = sum_k a_k phi_k(tau),   d(tau) = sum_k b_k phi_k(tau),   k = 0 ... order
    phi_k(tau) = prod_(j <= k) tau / (tau + tau_j)  prod_(j > k) tau_j / (tau + tau_j)

`phi_k` is the power `tau^k` over the common denominator `prod (tau + tau_j)`, of size one between two knots and small
elsewhere: real poles and zeros give positive coefficients, and nothing cancels over any number of decades. With
`w = (z - 1) / (z + 1)`, `w^2 = -tau` on the unit circle: a root `t` off the half-line `[0, inf)` gives the zero or pole
`w = -sqrt(-t)` in the open left half-plane, inside the unit circle of `z`.

References
----------
W. Dinkelbach, "On nonlinear fractional programming", Management Science 13 (1967) 492-498.
C. L. Lawson and R. J. Hanson, "Solving Least Squares Problems", Prentice-Hall (1974), chapter 23.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from functools import cached_property

import numpy as np

from ...core import EPS, AnyArray, ArrayLike, ConfigError, DataError, DimensionError, KrosError, frozen
from ...core.linalg import qr_triangle
from ...core.lti import StateSpace, gain
from ..forms import check_grid
from ..settings import MAGNITUDE, WEIGHT
from .sections import Sections, bilinear_squared


@frozen
class FittedMagnitude:
    """A system whose magnitude bounds data."""

    system: StateSpace  # one input, one output, stable and minimum phase
    overbound_db: float  # largest distance between the system's magnitude and the data; the smallest is zero

    @property
    def order(self) -> int:
        """Number of states."""
        return self.system.n_states


def fit_magnitude(
    freqs_hz: ArrayLike,
    magnitude: ArrayLike,
    sample_period_s: float,
    *,
    max_order: int = WEIGHT.max_order,
    tolerance_db: float = WEIGHT.tolerance_db,
) -> FittedMagnitude:
    r"""Return a discrete system whose magnitude is the tightest uniform bound of the data.

    Parameters
    ----------
    freqs_hz : array_like, shape (n_freqs,), Hz
        Increasing, from zero at least to Nyquist at most; both ends allowed.
    magnitude : array_like, shape (n_freqs,)
        Non-negative. Values below 1e-8 of the largest count as that; all zero gives the zero system.
    sample_period_s : float, s
    max_order : int
        The smallest order within the tolerance is taken, or the best up to this one.
    tolerance_db : float, dB
        Distance at which a lower order is good enough.

    Returns
    -------
    FittedMagnitude
        With ``system``, ``order`` and ``overbound_db``. The bound holds at the given frequencies, for the system as
        returned; between them the fit is smooth, and positive.

    Raises
    ------
    DataError
        Magnitudes negative, NaN or infinite.
    ConfigError
        A negative order, or frequencies that are no grid.

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
    freqs, values = check_grid(freqs_hz, sample_period_s), np.asarray(magnitude, float)
    if values.shape != freqs.shape:
        raise DimensionError(f"Magnitude fit: needs one at each of {len(freqs)} frequencies, found {values.shape}.")
    valid = np.isfinite(values) & (values >= 0)
    if not valid.all():
        where = int(np.argmin(valid))
        problem = "Magnitude fit: magnitudes should be finite and not negative"
        raise DataError(f"{problem}, found {values[where]} at {freqs[where]} Hz; look at the responses.")
    if max_order < 0:
        raise ConfigError(f"Magnitude fit: max_order should not be negative, found {max_order}.")
    if not values.any():
        return FittedMagnitude(gain([[0.0]], sample_period_s), 0.0)
    values = np.maximum(values, MAGNITUDE.floor * values.max())
    *_, bound = rising_bounds(bilinear_squared(freqs, sample_period_s), values, max_order, tolerance_db)
    (system,) = bound.sections.systems(sample_period_s)
    ratio = np.abs(system.frequency_response(freqs)[:, 0, 0]) / values
    touch = (1 + 4 * EPS) / ratio.min()
    touching = gain([[touch]], sample_period_s) @ system
    return FittedMagnitude(touching, float(20 * np.log10(ratio.max() / ratio.min())))


@frozen
class Bound:
    """Magnitudes above data, and their largest excess."""

    sections: Sections
    excess_db: float


def rising_bounds(tau: AnyArray, magnitude: AnyArray, max_order: int, enough_db: float) -> Iterator[Bound]:
    """Yield the tightest bounds of positive magnitudes at increasing tau, by order, or a lower one that is enough.

    Further poles and zeros would all but cancel, wherever rounding has them.
    """
    values = np.maximum(magnitude, MAGNITUDE.floor * magnitude.max())
    unit = np.log(values).mean()
    targets = (values / np.exp(unit)) ** 2
    top, none = targets.max(), np.zeros(0)
    bound = Bound(Sections.of_roots(np.log(top) / 2, none, none), 10 * float(np.log10(top / targets.min())))
    for order in range(max_order + 1):
        if order and bound.excess_db > max(enough_db, MAGNITUDE.exact_db):
            richer = _better(tau, targets, order, bound)
            bound = richer if richer.excess_db < bound.excess_db - MAGNITUDE.worth_db else bound
        yield replace(bound, sections=replace(bound.sections, level=bound.sections.level + unit))


def _better(tau: AnyArray, targets: AnyArray, order: int, known: Bound) -> Bound:
    """Return the bound by the best n / d of one order, positive on the whole axis, or the known one if that is none."""
    knots, cuts = np.exp(_bends(tau, np.log(targets), order)), np.zeros(0)
    for _ in range(MAGNITUDE.rounds):
        best, ratio = _dinkelbach(tau, targets, knots, cuts, 10 ** (known.excess_db / 10))
        if best is None:
            break
        try:
            zeros = best.not_positive()
            if not zeros.size:
                return Bound(best.factor(), 10 * float(np.log10(ratio)))
        except KrosError:  # roots at zero, at infinity or too near the unit circle
            break
        cuts = np.unique(np.concatenate([cuts, zeros, np.sqrt(zeros[1:] * zeros[:-1])]))
    return known


def _bends(tau: AnyArray, log: AnyArray, count: int) -> AnyArray:
    """Return log tau, shape (count,), half as dense as log magnitudes bend over log tau, half evenly spaced."""
    inside = (tau > 0) & (tau < MAGNITUDE.highest)
    x, y = (np.log(tau[inside]), log[inside]) if inside.any() else np.zeros((2, 1))
    even = np.linspace(x[0], x[-1], len(x) + 2)
    bend = np.cumsum(np.abs(np.diff(np.interp(even, x, y), 2)))
    share = bend / (bend[-1] or 1.0) + np.linspace(0.0, 1.0, len(bend))
    return np.interp((np.arange(count) + 0.5) / count * share[-1], share, even[1:-1])


def _dinkelbach(
    tau: AnyArray, targets: AnyArray, knots: AnyArray, cuts: AnyArray, gamma: float
) -> tuple[RationalMagnitude | None, float]:
    """Return the bound of the smallest ratio below gamma, and that; n and d do not fall at DC, Nyquist and cuts."""
    phi, edges = basis(tau, knots), np.concatenate([[0.0], cuts, [np.inf]])
    edge = basis(edges, knots) - MAGNITUDE.edge * phi[np.searchsorted(tau, edges).clip(max=len(tau) - 1)]
    best, least, scale = None, np.inf, targets**-0.5  # n and d share the slope
    while True:
        try:
            a, b = _program(phi / scale[:, None], targets, edge, gamma)
        except (RuntimeError, np.linalg.LinAlgError):  # no solution in as many steps as nnls takes, or no unique one
            return best, least
        n, d = phi @ a, phi @ b
        if not ((d > 0) & (n > 0)).all():
            return best, least
        ratio = n / (targets * d)
        spread = float(ratio.max() / ratio.min())
        if spread >= gamma * MAGNITUDE.settled:
            return best, least
        if spread * (1 + MAGNITUDE.room) < least:
            best, least = RationalMagnitude(a / ratio.min(), b, knots), spread
        gamma, scale = spread, d


def _program(phi: AnyArray, targets: AnyArray, edge: AnyArray, gamma: float) -> list[AnyArray]:
    """Return a and b, up to a factor, of the program's solution, phi divided by the denominator before."""
    from scipy.linalg import block_diag
    from scipy.optimize import nnls

    n = phi / targets[:, None]
    high, low = np.hstack([-n, gamma * phi]), np.hstack([n, -phi])
    above = np.vstack([high, low, block_diag(edge, edge)])
    limits = np.repeat([len(n) ** -0.5, 0.0], [len(n), len(above) - len(n)])
    R = qr_triangle(np.vstack([high, MAGNITUDE.below * low]))
    rows = np.vstack([np.linalg.solve(R.T, above.T), limits])
    solution = rows[:-1] @ nnls(rows, np.eye(len(rows))[-1])[0]
    return np.split(np.linalg.solve(R, solution), 2)


_ROUNDING = 4096 * EPS


@frozen
class RationalMagnitude:
    """Squared magnitude `n / d` in tau."""

    numerator: AnyArray  # (order + 1,): coefficients a
    denominator: AnyArray  # (order + 1,): coefficients b
    knots: AnyArray  # (order,): the tau_k

    @cached_property
    def sides(self) -> tuple[AnyArray, AnyArray]:
        """Roots in tau of numerator and denominator."""
        return roots(self.numerator, self.knots), roots(self.denominator, self.knots)

    def not_positive(self) -> AnyArray:
        """Return the tau >= 0 at which numerator or denominator vanish, in increasing order."""
        every = np.concatenate(self.sides)
        return np.sort(every.real[(every.real >= 0) & (np.abs(every.imag) <= _ROUNDING * np.abs(every))])

    def factor(self) -> Sections:
        """Return the stable, minimum-phase system of a positive squared magnitude, or raise a `KrosError`."""
        zeros, poles = (-np.sqrt(-side.astype(complex)) for side in self.sides)
        every = np.concatenate([zeros, poles])
        distance = 1 - np.abs((1 + every) / (1 - every)).max(initial=0.0)
        if not distance > _ROUNDING / 10:
            problem = f"a pole or zero is {distance:.1e} from the unit circle, too near for double precision"
            raise KrosError(f"Spectral factor: {problem}; try another order.")
        return Sections.of_roots(float(np.log(self.numerator[0] / self.denominator[0]) / 2), zeros, poles)


def basis(tau: AnyArray, knots: AnyArray) -> AnyArray:
    """Return phi, shape (..., order + 1)."""
    with np.errstate(divide="ignore"):
        up = 1.0 / (1.0 + knots / tau[..., None])
    down = 1.0 / (1.0 + tau[..., None] / knots)
    one = np.ones((*tau.shape, 1))
    rising = np.concatenate([one, np.cumprod(up, axis=-1)], axis=-1)
    falling = np.concatenate([np.cumprod(down[..., ::-1], axis=-1)[..., ::-1], one], axis=-1)
    return rising * falling


def roots(coefficients: AnyArray, knots: AnyArray) -> AnyArray:
    """Return the roots in tau of `sum a_k phi_k`, whose first and last coefficients are not zero."""
    if not (np.isfinite(coefficients).all() and coefficients[0] and coefficients[-1]):
        raise KrosError(f"Spectral factor: no {len(knots)} roots of coefficients {coefficients}; try another order.")
    unit = np.exp(np.log(knots).sum() / max(len(knots), 1))  # in the middle of the roots, which spread over decades
    powers = coefficients * np.append(np.cumprod(knots[::-1] / unit)[::-1], 1.0)
    return np.roots(powers[::-1]) * unit
