"""What people would use instead: steady-state Kalman gains with guessed or tuned white noise."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
import numpy.typing as npt

from ..synthesis import kalman
from ..synthesis.result import Synthesis

Array = npt.NDArray[np.float64]
_SWEEP_DECADES = (-6, 10)
_PER_DECADE = 1


def noise_covariances(residual_covariance: Array, resolution: Array) -> tuple[Array, Array]:
    """Return the white-noise guess: process noise from one-step residuals, measurement noise from the resolution.

    Parameters
    ----------
    residual_covariance : ndarray, shape (unit, n, n)
    resolution : ndarray, shape (q,)
        Quantisation step of each measurement; a uniform error within it has variance ``step^2 / 12``.

    Returns
    -------
    Q : ndarray, shape (n, n)
    R : ndarray, shape (q, q)
    """
    return residual_covariance.mean(axis=0), np.diag(resolution**2 / 12)


def kalman_candidates(A: Array, C: Array, scale: Array, R: Array, dt: float) -> Iterator[tuple[float, Synthesis]]:
    """Sweep white process noise of equal relative size in every state over sixteen decades.

    Parameters
    ----------
    A : ndarray, shape (n, n)
    C : ndarray, shape (q, n)
    scale : ndarray, shape (n,)
        Range of every state.
    R : ndarray, shape (q, q)
    dt : float, s

    Yields
    ------
    float
        Process noise variance relative to the squared ranges and to the relative measurement noise.
    Synthesis
    """
    base = np.trace(R) / max(np.sum((C @ scale) ** 2), np.finfo(float).tiny)
    start, stop = _SWEEP_DECADES
    for level in np.logspace(start, stop, _PER_DECADE * (stop - start) + 1):
        yield float(level), kalman(A, C, level * base * np.diag(scale**2), R, dt)
