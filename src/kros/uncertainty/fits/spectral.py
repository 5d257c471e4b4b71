r"""Spectral factors: a stable, minimum-phase system from a squared magnitude that is rational in tau.

The squared magnitude is `n / d` with

    n(tau) = sum_k a_k phi_k(tau),   d(tau) = sum_k b_k phi_k(tau),   k = 0 ... order
    phi_k(tau) = prod_(j <= k) tau / (tau + tau_j)  prod_(j > k) tau_j / (tau + tau_j)

`phi_k` is the power `tau^k` over the common denominator `prod (tau + tau_j)`, of size one between two knots and small elsewhere: real poles
and zeros give positive coefficients, and nothing cancels over any number of decades. Only the numerators of `n` and `d` matter. With
`w = (z - 1) / (z + 1)`, `w^2 = -tau` on the unit circle: a root `t` off the half-line `[0, inf)` gives the zero or pole `w = -sqrt(-t)` in
the open left half-plane, which is the inside of the unit circle in `z`. Roots come from high-precision arithmetic, because they spread over
twice as many decades as the frequencies.

The system is a cascade of sections of first and second order in `zeta = z - 1`: poles next to `z = 1` keep their relative precision.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import reduce
from typing import Any

import numpy as np
import numpy.typing as npt

from ...core.errors import KrosError
from ...core.lti import StateSpace, gain

Array = npt.NDArray[Any]

_TOP = 10.0  # tau beyond which (80 % of Nyquist) no knots are placed
_DIGITS = 60
_POLISH = 60
_REAL = 1e-12  # relative imaginary part below which a root counts as real
_INSIDE = 1e-13  # distance from the unit circle that is no rounding


@dataclass(frozen=True, eq=False)
class RationalMagnitude:
    """Squared magnitude `n / d` in tau."""

    numerator: Array  # (order + 1,): coefficients a
    denominator: Array  # (order + 1,): coefficients b
    knots: Array  # (order,): the tau_k

    def __call__(self, tau: npt.ArrayLike) -> Array:
        """Return the squared magnitude, shape of `tau`; infinity (Nyquist) is allowed."""
        phi = basis(np.asarray(tau, float), self.knots)
        return (phi @ self.numerator) / (phi @ self.denominator)


def basis(tau: Array, knots: Array) -> Array:
    """Return phi, shape (..., order + 1)."""
    with np.errstate(divide="ignore"):
        up = 1.0 / (1.0 + knots / tau[..., None])
    down = 1.0 / (1.0 + tau[..., None] / knots)
    one = np.ones((*tau.shape, 1))
    rising = np.concatenate([one, np.cumprod(up, axis=-1)], axis=-1)
    falling = np.concatenate([np.cumprod(down[..., ::-1], axis=-1)[..., ::-1], one], axis=-1)
    return rising * falling


def log_knots(tau: Array, log: Array, count: int, even: float) -> Array:
    """Return log tau, shape (count,), as dense as log magnitudes bend over log tau, plus a share that is evenly spaced."""
    inside = (tau > 0) & (tau < _TOP)
    if not count or inside.sum() < 3:
        return np.linspace(-10.0, 0.0, count + 2)[1:-1]
    x = np.log(tau[inside])
    middle = (x[1:] + x[:-1]) / 2
    bend = np.concatenate([[0.0], np.cumsum(np.abs(np.diff(np.diff(log[inside]) / np.diff(x))))])
    bend = bend / bend[-1] if bend[-1] > 0 else bend
    share = (1 - even) * bend + even * (middle - middle[0]) / (middle[-1] - middle[0])
    return np.interp((np.arange(count) + 0.5) / count * share[-1], share, middle)


def roots(coefficients: Array, knots: Array) -> tuple[list[complex], float]:
    """Return the roots in tau of `sum a_k phi_k`, and the coefficient of the highest power; those that do not settle are refused."""
    import mpmath

    order = len(knots)
    with mpmath.workdps(_DIGITS):
        unit = mpmath.mpf(float(np.exp(np.log(knots).mean()))) if order else mpmath.mpf(1)
        powers, factor = [mpmath.mpf(0)] * (order + 1), mpmath.mpf(1)  # lowest power first
        for k in range(order, -1, -1):
            powers[k] = mpmath.mpf(float(coefficients[k])) * factor
            factor *= mpmath.mpf(float(knots[k - 1])) / unit if k else 1
        low = next((k for k in range(order + 1) if powers[k] != 0), order)
        high = next((k for k in range(order, -1, -1) if powers[k] != 0), 0)
        inner = powers[low : high + 1]
        try:
            with np.errstate(all="ignore"):
                started = np.roots([float(c) for c in reversed(inner)]) if high >= low else np.full(1, np.nan)
        except np.linalg.LinAlgError:  # coefficients that are not finite
            started = np.full(1, np.nan)
        found, change = [mpmath.mpc(r) for r in started], mpmath.inf
        for _ in range(_POLISH if np.isfinite(started).all() else 0):
            change = max((_polish(inner, found, i) for i in range(len(found))), default=mpmath.mpf(0))
            if change < mpmath.mpf(10) ** -25:
                return [0j] * low + [complex(r * unit) for r in found], float(powers[order])
    raise KrosError(
        f"Spectral factor: the roots of a polynomial of degree {high - low} did not settle (last change {float(change):.1e}); try another order."
    )


def _polish(powers: list[Any], found: list[Any], i: int) -> Any:
    """One Aberth step of root i in high precision, in place; return its relative size."""
    z = found[i]
    value, slope = powers[-1], 0
    for c in reversed(powers[:-1]):
        slope = slope * z + value
        value = value * z + c
    if value == 0 or slope == 0 or z == 0:
        return abs(value)
    step = value / slope
    apart = 1 - step * sum(1 / (z - other) for k, other in enumerate(found) if k != i and other != z)
    step = step / apart if apart != 0 else step
    found[i] = z - step
    return abs(step) / abs(z)


def on_half_line(found: Sequence[complex]) -> list[float]:
    """Return the roots that lie on the frequency axis, tau >= 0: there the function is not positive."""
    return [r.real for r in found if r.real >= 0 and abs(r.imag) <= _REAL * abs(r)]


def spectral_factor(magnitude: RationalMagnitude, sample_period_s: float) -> StateSpace:
    """Return the stable, minimum-phase system, with as many states as knots, whose squared magnitude is given."""
    zero_roots, lead_n = roots(magnitude.numerator, magnitude.knots)
    pole_roots, lead_d = roots(magnitude.denominator, magnitude.knots)
    bad = on_half_line(zero_roots) + on_half_line(pole_roots)
    if not (lead_n * np.sign(lead_d) > 0 and np.isfinite([lead_n, lead_d]).all()):
        bad.append(float("inf"))
    if bad:
        raise KrosError(
            f"Spectral factor: the squared magnitude is not positive and finite at tau = {bad}; lift the numerator or refine the grid."
        )
    zeros, poles = ([-np.sqrt(-complex(r)) for r in side] for side in (zero_roots, pole_roots))
    _check_inside([*zeros, *poles])
    return cascade(zeros, poles, float(np.sqrt(abs(lead_n)) / np.sqrt(abs(lead_d))), sample_period_s)


def _check_inside(found: Sequence[complex]) -> None:
    """Raise a `KrosError` when poles or zeros in w are on the unit circle of z as far as double precision tells."""
    distance = np.array([1 - abs(1 + _to_zeta(w)) for w in found])
    if not (distance > _INSIDE).all():
        raise KrosError(
            f"Spectral factor: a pole or zero is {distance.min():.1e} from the unit circle, which double precision does not hold; try another order."
        )


def cascade(zeros: Sequence[complex], poles: Sequence[complex], factor: float, sample_period_s: float) -> StateSpace:
    """Return `factor * prod (w - q_i) / prod (w - p_i)`, equally many zeros and poles, complex ones in conjugate pairs, as a series of sections in z."""
    sections, total = [], factor
    for q, p in _pair(list(zeros), list(poles)):
        total *= float(np.real(np.prod([1 - x for x in q]) / np.prod([1 - x for x in p])))
        sections.append(_section([_to_zeta(x) for x in q], [_to_zeta(x) for x in p], sample_period_s))
    scale = gain([[total]], sample_period_s)
    return reduce(lambda system, section: section @ system, sections, scale)


def _to_zeta(w: complex) -> complex:
    """From w to zeta = z - 1, without subtracting near one."""
    return 2 * w / (1 - w)


def _section(q: list[complex], p: list[complex], dt: float) -> StateSpace:
    """Section with unit feedthrough: `(zeta - q) / (zeta - p)` of first or second order."""
    if len(p) == 1:
        step = p[0].real - q[0].real
        size = np.sqrt(abs(step))
        A, B, C = np.array([[1 + p[0].real]]), np.array([[size]]), np.array([[np.copysign(size, step)]])
        return StateSpace(A, B, C, np.ones((1, 1)), dt)
    # Numerator minus denominator: b1 zeta + b0.
    b1 = float(np.real(p[0] + p[1] - q[0] - q[1]))
    b0 = float(np.real(q[0] * q[1] - p[0] * p[1]))
    product = float(np.real(p[0] * p[1]))
    kappa = np.sqrt(product)
    s1, s2 = -p[0].real, -p[1].real
    imag = p[0].imag
    A = np.array([[1 - s1, kappa], [-(imag**2) / kappa, 1 - s2]])
    C = np.array([[(b0 - b1 * s1) / kappa, b1]])
    size = np.sqrt(max(float(np.abs(C).max()), np.finfo(float).tiny))
    return StateSpace(A, np.array([[0.0], [size]]), C / size, np.ones((1, 1)), dt)


def _pair(zeros: list[complex], poles: list[complex]) -> list[tuple[list[complex], list[complex]]]:
    """Group poles with near zeros into sections of order one and two."""
    pole_pairs, pole_reals = _split(poles)
    zero_pairs, zero_reals = _split(zeros)
    sections = []
    for p in pole_pairs:
        near_pair = min(zero_pairs, key=lambda q: _distance(q, p), default=None)
        near_reals = sorted(zero_reals, key=lambda q: _distance(q, p))[:2]
        if near_pair is None or (
            len(near_reals) == 2 and max(_distance(q, p) for q in near_reals) < _distance(near_pair, p)
        ):
            zero_reals = _without(zero_reals, near_reals)
            sections.append((near_reals, [p, np.conj(p)]))
        else:
            zero_pairs.remove(near_pair)
            sections.append(([near_pair, np.conj(near_pair)], [p, np.conj(p)]))
    for q in zero_pairs:
        near = sorted(pole_reals, key=lambda p: _distance(q, p))[:2]
        pole_reals = _without(pole_reals, near)
        sections.append(([q, np.conj(q)], near))
    sections += [([q], [p]) for q, p in zip(sorted(zero_reals, key=abs), sorted(pole_reals, key=abs), strict=True)]
    return sections


def _split(values: list[complex]) -> tuple[list[complex], list[complex]]:
    """Upper halves of the conjugate pairs, and the real ones."""
    real = [v for v in values if abs(v.imag) <= _REAL * abs(v)]
    upper = [v for v in values if v not in real and v.imag > 0]
    if len(real) + 2 * len(upper) != len(values):
        raise KrosError(
            f"Spectral factor: complex roots should come in conjugate pairs, found {values}; try another order."
        )
    return upper, [complex(v.real) for v in real]


def _distance(one: complex, other: complex) -> float:
    """Distance in decades between magnitudes."""
    sizes = np.clip([abs(one), abs(other)], 1e-30, 1e30)
    return float(abs(np.log10(sizes[0] / sizes[1])))


def _without(values: list[complex], taken: list[complex]) -> list[complex]:
    rest = list(values)
    for value in taken:
        rest.remove(value)
    return rest
