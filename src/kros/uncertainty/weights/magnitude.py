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
`w = -sqrt(-t)` in the open left half-plane, inside the unit circle of `z`. Roots come from arithmetic of 30 digits,
because they spread over twice as many decades as the frequencies.

References
----------
W. Dinkelbach, "On nonlinear fractional programming", Management Science 13 (1967) 492-498.
C. L. Lawson and R. J. Hanson, "Solving Least Squares Problems", Prentice-Hall (1974), chapter 23.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace
from functools import cached_property
from itertools import chain, pairwise

import numpy as np

from ...core import (
    EPS,
    TINY,
    AnyArray,
    ArrayLike,
    ConfigError,
    DataError,
    DimensionError,
    KrosError,
    StateSpace,
    frozen,
    gain,
)
from ...core.linalg import qr_triangle
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
    KrosError
        When no program of any order could be solved.

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
    freqs, dt, best = check_grid(freqs_hz, sample_period_s), sample_period_s, None
    values = np.asarray(magnitude, float)
    if values.shape != freqs.shape:
        raise DimensionError(f"Magnitude fit: needs one at each of {len(freqs)} frequencies, found {values.shape}.")
    valid = np.isfinite(values) & (values >= 0)
    if not valid.all():
        where = int(np.argmin(valid))
        problem = "Magnitude fit: magnitudes should be finite and not negative"
        raise DataError(f"{problem}, found {values[where]} at {freqs[where]} Hz; look at the responses.")
    values = np.maximum(values, MAGNITUDE.floor * values.max())
    if max_order < 0:
        raise ConfigError(f"Magnitude fit: max_order should not be negative, found {max_order}.")
    if not values.any():
        return FittedMagnitude(gain([[0.0]], dt), 0.0)
    for bound in rising_bounds(bilinear_squared(freqs, dt), values, max_order):
        fitted = _touching(bound, freqs, values, dt)
        best = fitted if best is None or fitted.overbound_db < best.overbound_db else best
        if best.overbound_db <= tolerance_db:
            break
    if best is None:
        raise KrosError("Magnitude fit: no program of any order was solved; look at the magnitudes.")
    return best


@frozen
class Bound:
    """Magnitudes above data, and their largest excess."""

    sections: Sections
    excess_db: float


def rising_bounds(tau: AnyArray, magnitude: AnyArray, max_order: int) -> Iterator[Bound]:
    """Yield the tightest bounds of positive magnitudes at increasing tau, order by order, or a better lower one."""
    values = np.maximum(magnitude, MAGNITUDE.floor * magnitude.max())
    unit = float(np.exp(np.mean(np.log(values))))
    targets = (values / unit) ** 2
    best, ratio, bound = RationalMagnitude(np.array([targets.max()]), np.ones(1), np.zeros(0)), np.inf, None
    for order in range(max_order + 1):
        better = best if not order else _best(tau, targets, order, ratio)
        if better is not None:
            best, ratio = better, float((better(tau) / targets).max())
            try:
                sections = best.factor().lifted(slice(0, 1), float(np.log(unit)))
                bound = Bound(sections, 10 * float(np.log10(ratio)))
            except KrosError:  # roots that do not settle, or too near the unit circle
                pass
        if bound is not None:
            yield bound
        if ratio < MAGNITUDE.exact:
            break


def _touching(bound: Bound, freqs: AnyArray, values: AnyArray, dt: float) -> FittedMagnitude:
    """Return the system of a bound, scaled until it touches the values as evaluated."""
    (system,) = bound.sections.systems(dt)
    ratio = np.abs(system.frequency_response(freqs)[:, 0, 0]) / values
    touch = (1 + 4 * EPS) / ratio.min()
    lifted = replace(system, C=system.C * touch, D=system.D * touch)
    return FittedMagnitude(lifted, float(20 * np.log10(ratio.max() / ratio.min())))


def _best(tau: AnyArray, targets: AnyArray, order: int, gamma: float) -> RationalMagnitude | None:
    """Return the best n / d of one order above the targets, positive on the whole axis, of a ratio below gamma."""
    knots, cuts = np.exp(_bends(tau, np.log(targets), order)), np.zeros(0)
    for _ in range(MAGNITUDE.rounds):
        best = _Grid.of(tau, targets, knots, cuts).best(gamma)
        try:
            zeros = best.not_positive() if best is not None else []
        except KrosError:  # multiple roots
            return None
        if not zeros:
            return best
        cuts = np.unique(np.concatenate([cuts, zeros, [np.sqrt(x * y) for x, y in pairwise(zeros)]]))
    return None


def _bends(tau: AnyArray, log: AnyArray, count: int) -> AnyArray:
    """Return log tau, shape (count,), half as dense as log magnitudes bend over log tau, half evenly spaced."""
    inside = (tau > 0) & (tau < MAGNITUDE.highest)
    if inside.sum() < 3:
        return np.linspace(-MAGNITUDE.highest, 0.0, count + 2)[1:-1]
    x = np.log(tau[inside])
    middle = (x[1:] + x[:-1]) / 2
    bend = np.concatenate([[0.0], np.cumsum(np.abs(np.diff(np.diff(log[inside]) / np.diff(x))))])
    share = bend / max(bend[-1], TINY) + (middle - middle[0]) / (middle[-1] - middle[0])
    return np.interp((np.arange(count) + 0.5) / count * share[-1], share, middle)


@frozen
class _Grid:
    """Squared magnitudes f to stay above, with the basis evaluated there."""

    targets: AnyArray  # (n_points,)
    knots: AnyArray  # (order,)
    phi: AnyArray  # (n_points, order + 1)
    edge: AnyArray  # (n_edges, order + 1): rows that keep n and d from falling at DC, Nyquist and cuts
    nearest: AnyArray  # (n_edges,): grid points next to these

    @classmethod
    def of(cls, tau: AnyArray, targets: AnyArray, knots: AnyArray, cuts: AnyArray) -> _Grid:
        """Evaluate the basis on a grid."""
        phi = basis(tau, knots)
        nearest = np.concatenate([[0], np.searchsorted(tau, cuts).clip(0, len(tau) - 1), [len(tau) - 1]])
        edge = MAGNITUDE.edge * phi[nearest] - basis(np.concatenate([[0.0], cuts, [np.inf]]), knots)
        return cls(targets, knots, phi, edge, nearest)

    def best(self, gamma: float) -> RationalMagnitude | None:
        """Return the bound of the smallest ratio; None where none is below gamma."""
        best, scale = None, self.targets**-0.5  # n and d share the slope
        while (solution := self._solved(scale, gamma)) is not None:
            n, d = self.phi @ solution[0], self.phi @ solution[1]
            if not ((d > 0) & (n > 0)).all():
                break
            ratio = n / (self.targets * d)
            spread = float(ratio.max() / ratio.min())
            if spread >= gamma * MAGNITUDE.settled:
                break
            best = RationalMagnitude(solution[0] / ratio.min(), solution[1], self.knots)
            gamma, scale = spread, d
            if spread < MAGNITUDE.exact:
                break
        return best

    def _solved(self, scale: AnyArray, gamma: float) -> tuple[AnyArray, AnyArray] | None:
        """Return a and b, up to a factor, of the program's solution; None where it has none."""
        from scipy.optimize import nnls

        d = self.phi / scale[:, None]
        n, none = d / self.targets[:, None], np.zeros_like(self.edge)
        high, low = np.hstack([-n, gamma * d]), np.hstack([n, -d])
        ends = np.block([[-self.edge / self.targets[self.nearest, None], none], [none, -self.edge]])
        limits = np.repeat([len(n) ** -0.5, 0.0], [len(n), len(n) + len(ends)])
        try:
            R = qr_triangle(np.vstack([high, MAGNITUDE.below * low]))
            rows = np.vstack([np.linalg.solve(R.T, np.vstack([high, low, ends]).T), limits])
        except np.linalg.LinAlgError:  # a basis function that is zero on the grid
            return None
        if not np.isfinite(rows).all():
            return None
        try:
            solution = rows[:-1] @ nnls(rows, np.eye(len(rows))[-1])[0]
        except RuntimeError:  # not solved in as many steps as nnls takes: no better bound from this denominator
            return None
        a, b = np.split(np.linalg.solve(R, solution), 2)
        return a, b


_ROUNDING = 4096 * EPS


@frozen
class RationalMagnitude:
    """Squared magnitude `n / d` in tau."""

    numerator: AnyArray  # (order + 1,): coefficients a
    denominator: AnyArray  # (order + 1,): coefficients b
    knots: AnyArray  # (order,): the tau_k

    def __call__(self, tau: ArrayLike) -> AnyArray:
        """Return the squared magnitude, shape of `tau`; infinity (Nyquist) is allowed."""
        phi = basis(np.asarray(tau, float), self.knots)
        return (phi @ self.numerator) / (phi @ self.denominator)

    @cached_property
    def sides(self) -> tuple[Sequence[complex], ...]:
        """Roots in tau of numerator and denominator."""
        return tuple(roots(c, self.knots) for c in (self.numerator, self.denominator))

    def not_positive(self) -> list[float]:
        """Return the tau >= 0 at which numerator or denominator vanish."""
        return sorted(r.real for r in chain(*self.sides) if r.real >= 0 and abs(r.imag) <= _ROUNDING * abs(r))

    def factor(self) -> Sections:
        """Return the stable, minimum-phase system of a positive squared magnitude, or raise a `KrosError`."""
        zeros, poles = ([-np.sqrt(-complex(r)) for r in side] for side in self.sides)
        distance = np.array([1 - abs((1 + w) / (1 - w)) for w in (*zeros, *poles)])
        if not (distance > _ROUNDING / 10).all():
            problem = f"a pole or zero is {distance.min():.1e} from the unit circle, too near for double precision"
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


def roots(coefficients: AnyArray, knots: AnyArray) -> Sequence[complex]:
    """Return the roots in tau of `sum a_k phi_k`, whose first and last coefficients are not zero."""
    import mpmath

    order = len(knots)
    if not (np.isfinite(coefficients).all() and coefficients[0] and coefficients[-1]):
        raise KrosError(f"Spectral factor: no {order} roots of coefficients {coefficients}; try another order.")
    with mpmath.workdps(MAGNITUDE.digits):
        unit = mpmath.mpf(float(np.exp(np.log(knots).mean()))) if order else mpmath.mpf(1)
        powers, factor = [mpmath.mpf(0)] * (order + 1), mpmath.mpf(1)  # highest power first
        for k in range(order, -1, -1):
            powers[order - k] = mpmath.mpf(float(coefficients[k])) * factor
            factor *= mpmath.mpf(float(knots[k - 1])) / unit if k else 1
        try:
            start = np.roots([float(c) for c in powers])
            settled = mpmath.polyroots(powers, maxsteps=60, extraprec=200, roots_init=start.tolist())
        except (mpmath.mp.NoConvergence, np.linalg.LinAlgError, ZeroDivisionError) as error:
            raise KrosError(f"Spectral factor: roots of degree {order} did not settle; try another order.") from error
        return [complex(r * unit) for r in settled]
