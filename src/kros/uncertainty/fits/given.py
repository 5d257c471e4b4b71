"""Magnitude fits with given poles: the best numerator, one linear program."""

from __future__ import annotations

from itertools import pairwise
from typing import Any

import numpy as np
import numpy.typing as npt

from ...core.errors import ConfigError, KrosError
from .spectral import RationalMagnitude, basis, on_half_line, roots

Array = npt.NDArray[Any]

_DIGITS = 60
_ROUNDS = 6


def pole_roots(poles: npt.ArrayLike) -> Array:
    """Return the roots in tau that belong to poles in z.

    Raises
    ------
    ConfigError
        When poles are not inside the unit circle, or complex ones not in pairs.
    """
    z = np.atleast_1d(np.asarray(poles, complex))
    if not (np.isfinite(z) & (np.abs(z) < 1)).all():
        raise ConfigError(f"Magnitude fit: given poles should be inside the unit circle, found {z[~(np.abs(z) < 1)]}.")
    if not np.allclose(np.sort_complex(z), np.sort_complex(np.conj(z)), rtol=0, atol=1e-12):
        raise ConfigError(f"Magnitude fit: complex poles should come in conjugate pairs, found {z}.")
    return -(((z - 1) / (z + 1)) ** 2)


def best_numerator(tau: Array, targets: Array, found: Array) -> RationalMagnitude:
    """Return the squared magnitude above the targets with the smallest largest ratio, for given roots of the denominator.

    Parameters
    ----------
    tau, targets : ndarray, shape (n_points,)
    found : ndarray of complex, shape (order,)
        Roots in tau, none on the half-line from zero to infinity.

    Raises
    ------
    KrosError
        When the program cannot be solved, or no numerator is positive.
    """
    from scipy.optimize import linprog

    knots = np.sort(np.abs(found)).clip(1e-30)
    denominator = _coefficients(found, knots)
    phi = basis(tau, knots)
    rows = phi / (targets * (phi @ denominator))[:, None]
    unit = 1 / rows.max(axis=0)
    guard = np.array([0.0, np.inf])
    for _ in range(_ROUNDS):
        edge = basis(guard, knots) * unit
        edge /= np.abs(edge).max(axis=1, keepdims=True)
        table = np.vstack(
            [
                np.hstack([-rows * unit, np.zeros((len(tau), 1))]),
                np.hstack([rows * unit, -np.ones((len(tau), 1))]),
                np.pad(-edge, ((0, 0), (0, 1))),
            ]
        )
        right = np.concatenate([-np.ones(len(tau)), np.zeros(len(tau)), np.full(len(guard), -1e-9)])
        result = linprog(
            np.append(np.zeros(len(unit)), 1.0), A_ub=table, b_ub=right, bounds=[(None, None)] * (len(unit) + 1), method="highs"
        )
        if result.x is None:
            break
        numerator = result.x[:-1] * unit
        bad = sorted(on_half_line(roots(numerator, knots)[0]))
        if not bad:
            return RationalMagnitude(numerator, denominator, knots)
        guard = np.unique(np.concatenate([guard, bad, [np.sqrt(x * y) for x, y in pairwise(bad)]]))
    raise KrosError(f"Magnitude fit: no positive numerator found for {len(found)} given poles; leave the poles free or add some.")


def _coefficients(found: Array, knots: Array) -> Array:
    """Coefficients in the basis of the polynomial with given roots, over the product of `tau + knot`."""
    import mpmath

    with mpmath.workdps(_DIGITS):
        powers = [mpmath.mpc(1)]
        for root in found:
            shifted, scaled = [mpmath.mpc(0), *powers], [*(mpmath.mpc(complex(root)) * c for c in powers), mpmath.mpc(0)]
            powers = [a - b for a, b in zip(shifted, scaled, strict=True)]
        tail, out = mpmath.mpf(1), []
        for k in range(len(knots), -1, -1):
            out.append(float(powers[k].real / tail))
            tail *= mpmath.mpf(float(knots[k - 1])) if k else 1
    return np.array(out[::-1])
