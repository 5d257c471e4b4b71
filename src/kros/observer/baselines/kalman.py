"""Steady-state Kalman gains for white noise of many sizes."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from ...core.arrays import Array
from ...core.errors import SynthesisError
from ...core.rounding import TINY
from ...synthesis import kalman
from ...synthesis.result import Synthesis


def kalman_candidates(A: Array, C: Array, shape: Array, R: Array, dt: float) -> Iterator[tuple[float, Synthesis]]:
    """Sweep the size of white process noise over sixteen decades, the covariance itself among them."""
    base = like_measurement_noise(C @ shape @ C.T, R)
    for level in sorted((1 / base, *np.logspace(-6, 10, 9).tolist())):
        try:
            yield level, kalman(A, C, level * base * shape, R, dt)
        except SynthesisError:
            continue


def like_measurement_noise(covariance: Array, R: Array) -> float:
    """Return the factor that brings a covariance of the measurements to the size of their noise R."""
    shares = np.diag(covariance) / np.diag(R)
    return 1.0 / max(float(np.mean(shares)), TINY)
