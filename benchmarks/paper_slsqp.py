"""The fit behind the paper's Figure 8, its method written anew: what `weights_beside_dkpy.py` compares with.

Every entry of the residual is bounded by a continuous transfer function whose coefficients minimise the sum of errors over the grid, under the
condition that no error is negative, by sequential quadratic programming from one start; roots in the right half-plane are reflected, and the
weight is sampled for a discrete synthesis.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt
from scipy.optimize import minimize
from scipy.signal import cont2discrete, zpk2ss

from kros.core.lti import StateSpace, gain

Array = npt.NDArray[Any]


def fit(omega: Array, magnitude: Array, order: int) -> tuple[Array, Array, float]:
    """Return zeros, poles and gain in s, omega in rad/s.

    Numerator `a_n s^n + ... + a_0`, denominator `s^n + ... + b_0`; at first the numerator is the peak alone and the denominator `s^n + 1`.
    """
    s = 1j * omega

    def error(c: Array) -> Array:
        return np.abs(np.polyval(c[: order + 1], s) / np.polyval(np.append(1.0, c[order + 1 :]), s)) - magnitude

    start = np.zeros(2 * order + 1)
    start[order] = magnitude.max() + 1e-6
    if order:
        start[-1] = 1.0
    with np.errstate(all="ignore"):
        found = minimize(
            lambda c: np.abs(error(c)).sum(),
            start,
            method="SLSQP",
            constraints={"type": "ineq", "fun": error},
            options={"maxiter": 100000},
        ).x
    zeros, poles = np.roots(found[: order + 1]), np.roots(np.append(1.0, found[order + 1 :]))
    return _reflected(zeros), _reflected(poles), float(found[0])


def response(fitted: tuple[Array, Array, float], omega: Array) -> Array:
    """Return the continuous response."""
    zeros, poles, factor = fitted
    s = 1j * omega[:, None]
    return factor * np.prod(s - zeros, axis=1) / np.prod(s - poles, axis=1)


def sampled(fitted: tuple[Array, Array, float], dt: float, method: str) -> StateSpace:
    """Return the system sampled with a zero-order hold (``zoh``) or by Tustin's rule (``bilinear``)."""
    zeros, poles, factor = fitted
    if not len(poles):
        return gain([[factor]], dt)
    A, B, C, D, _ = cont2discrete(zpk2ss(zeros, poles, factor), dt, method)
    return StateSpace(A, B, C, D, dt)


def _reflected(roots: Array) -> Array:
    return -np.abs(roots.real) + 1j * roots.imag
