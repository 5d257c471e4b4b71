"""Quasi-Newton descent (BFGS) for smooth and for nonsmooth functions that are infinite where a loop is unstable.

The line search brackets a point with sufficient decrease and enough slope change (weak Wolfe conditions). It needs neither second derivatives nor smoothness,
and treats infinity as a step that was too long.

References
----------
A. S. Lewis and M. L. Overton, "Nonsmooth optimization via quasi-Newton methods", Mathematical Programming 141 (2013) 135-163.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import numpy.typing as npt

Array = npt.NDArray[Any]
Objective = Callable[[Array], tuple[float, Array]]

_ARMIJO, _WOLFE, _TRIALS = 1e-4, 0.9, 40


def bfgs(objective: Objective, x: Array, iterations: int = 200, tolerance: float = 1e-9) -> Array:
    """Return a point with a lower value of the objective.

    Parameters
    ----------
    objective : callable
        Value and gradient; the value may be infinite, but not at the start.
    x : ndarray, shape (n,)
    iterations : int
    tolerance : float
        Ends when ten steps together lower the value by less than this fraction.
    """
    value, gradient = objective(x)
    H = np.eye(x.size)
    history = [value]
    for k in range(iterations):
        direction = -H @ gradient
        if direction @ gradient >= 0:
            H, direction = np.eye(x.size), -gradient
        found = _search(objective, x, value, gradient, direction)
        if found is None:
            break
        x_new, value, gradient_new = found
        s, y = x_new - x, gradient_new - gradient
        if k == 0 and (scale := float(y @ y)) > 0:
            H = np.eye(x.size) * max(float(s @ y) / scale, 1e-12)
        H = _update(H, s, y)
        x, gradient = x_new, gradient_new
        history.append(value)
        if len(history) > 10 and history[-11] - value <= tolerance * abs(value):
            break
    return x


def _update(H: Array, s: Array, y: Array) -> Array:
    curvature = float(s @ y)
    if curvature <= 1e-14 * float(np.linalg.norm(s) * np.linalg.norm(y)):
        return H
    Hy = H @ y
    return H + np.outer(s, s) * ((1 + float(y @ Hy) / curvature) / curvature) - (np.outer(Hy, s) + np.outer(s, Hy)) / curvature


def _search(objective: Objective, x: Array, value: float, gradient: Array, direction: Array) -> tuple[Array, float, Array] | None:
    """Step with sufficient decrease, and where possible enough slope change; None where nothing decreases."""
    slope = float(gradient @ direction)
    low, high, t = 0.0, np.inf, 1.0
    best: tuple[Array, float, Array] | None = None
    for _ in range(_TRIALS):
        trial = x + t * direction
        found, g = objective(trial)
        if not found <= value + _ARMIJO * t * slope:
            high = t
        else:
            best = (trial, found, g)
            if float(g @ direction) >= _WOLFE * slope:
                break
            low = t
        t = (low + high) / 2 if np.isfinite(high) else 2 * t
    return best
