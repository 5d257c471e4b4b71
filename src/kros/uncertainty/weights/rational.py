r"""Squared magnitudes that are rational in tau, and the stable, minimum-phase systems that have them.

    n(tau) = sum_k a_k phi_k(tau),   d(tau) = sum_k b_k phi_k(tau),   k = 0 ... order
    phi_k(tau) = prod_(j <= k) tau / (tau + tau_j)  prod_(j > k) tau_j / (tau + tau_j)

`phi_k` is the power `tau^k` over the common denominator `prod (tau + tau_j)`, of size one between two knots and small
elsewhere: real poles and zeros give positive coefficients, and nothing cancels over any number of decades. With
`w = (z - 1) / (z + 1)`, `w^2 = -tau` on the unit circle: a root `t` off the half-line `[0, inf)` gives the zero or pole
`w = -sqrt(-t)` in the open left half-plane, inside the unit circle of `z`. Roots come from arithmetic of 90 digits,
because they spread over twice as many decades as the frequencies.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from ...core.errors import KrosError
from ..settings import MAGNITUDE
from .sections import Sections

Array = npt.NDArray[Any]

_ROUNDING = 4096 * np.finfo(float).eps


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

    def not_positive(self) -> list[float]:
        """Return the tau >= 0 at which numerator or denominator vanish."""
        sides = (roots(c, self.knots) for c in (self.numerator, self.denominator))
        return sorted(r.real for side in sides for r in side if r.real >= 0 and abs(r.imag) <= _ROUNDING * abs(r))

    def factor(self) -> Sections:
        """Return the stable, minimum-phase system whose squared magnitude this is, or raise a `KrosError`."""
        bad = self.not_positive()
        ends = self.numerator[[0, -1]] / self.denominator[[0, -1]]
        if bad or not (np.isfinite(ends).all() and (ends > 0).all()):
            raise KrosError(
                f"Spectral factor: the squared magnitude is not positive and finite, {ends} at DC and Nyquist, zero or "
                f"infinite at tau = {bad}; try another order."
            )
        sides = (roots(c, self.knots) for c in (self.numerator, self.denominator))
        zeros, poles = ([-np.sqrt(-complex(r)) for r in side] for side in sides)
        distance = np.array([1 - abs((1 + w) / (1 - w)) for w in (*zeros, *poles)])
        if not (distance > _ROUNDING / 10).all():
            raise KrosError(
                f"Spectral factor: a pole or zero is {distance.min():.1e} from the unit circle, which double precision "
                "does not hold; try another order."
            )
        return Sections.of_roots(float(np.log(ends[0]) / 2), zeros, poles)


def basis(tau: Array, knots: Array) -> Array:
    """Return phi, shape (..., order + 1)."""
    with np.errstate(divide="ignore"):
        up = 1.0 / (1.0 + knots / tau[..., None])
    down = 1.0 / (1.0 + tau[..., None] / knots)
    one = np.ones((*tau.shape, 1))
    rising = np.concatenate([one, np.cumprod(up, axis=-1)], axis=-1)
    falling = np.concatenate([np.cumprod(down[..., ::-1], axis=-1)[..., ::-1], one], axis=-1)
    return rising * falling


def roots(coefficients: Array, knots: Array) -> Sequence[complex]:
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
            raise KrosError(
                f"Spectral factor: roots of a polynomial of degree {order} did not settle; try another."
            ) from error
        return [complex(r * unit) for r in settled]
