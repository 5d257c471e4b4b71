"""Gains to compare with: steady-state Kalman gains with guessed or tuned white noise, and placed poles."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
import numpy.typing as npt

from ...core.errors import SynthesisError
from ...synthesis import kalman, luenberger
from ...synthesis.result import Synthesis

Array = npt.NDArray[np.float64]
_SWEEP_DECADES = (-6, 10)
_DECADES_APART = 2
_FASTER = (1.02, 1.1, 1.25, 1.6, 2.0, 3.2, 5.0, 8.0, 13.0, 20.0)


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


def kalman_candidates(A: Array, C: Array, shape: Array, R: Array, dt: float) -> Iterator[tuple[float, Synthesis]]:
    """Sweep the size of white process noise over sixteen decades; the covariance as it is, the textbook's choice, is among them.

    Sizes for which there is no stable filter are left out.

    Parameters
    ----------
    A : ndarray, shape (n, n)
    C : ndarray, shape (q, n)
    shape : ndarray, shape (n, n) or (n,)
        Covariance of the process noise; or the range of every state, for noise of equal relative size.
    R : ndarray, shape (q, q)
    dt : float, s

    Yields
    ------
    float
        Process noise, as variance of the measured combinations relative to the measurement noise, on average over them.
    Synthesis
    """
    shape = np.diag(shape**2) if shape.ndim == 1 else shape
    base = like_measurement_noise(C @ shape @ C.T, R)
    start, stop = _SWEEP_DECADES
    for level in sorted((1 / base, *np.logspace(start, stop, (stop - start) // _DECADES_APART + 1).tolist())):
        try:
            yield level, kalman(A, C, level * base * shape, R, dt)
        except SynthesisError:
            continue


def like_measurement_noise(covariance: Array, R: Array) -> float:
    """Return the factor that brings a covariance of the measurements to the size of their noise R, as a mean over the measurements' own units."""
    shares = np.diag(covariance) / np.diag(R)
    return 1.0 / max(float(np.mean(shares)), np.finfo(float).tiny)


def luenberger_candidates(A: Array, C: Array, dt: float) -> Iterator[tuple[float, Synthesis]]:
    """Place the poles of the error dynamics at those of the model, made faster by growing factors.

    A pole ``z`` becomes ``z**factor``: the decay rate and the frequency of its continuous counterpart grow alike; a negative one, which has none,
    keeps its sign. Factors whose poles cannot be placed are left out. One would be the model alone.

    Parameters
    ----------
    A : ndarray, shape (n, n)
        Stable.
    C : ndarray, shape (q, n)
    dt : float, s

    Yields
    ------
    float
        The factor.
    Synthesis
    """
    poles = np.linalg.eigvals(A).astype(complex)
    real = poles.imag == 0
    for factor in _FASTER:
        wanted = np.abs(poles) ** factor * np.exp(1j * np.angle(poles) * np.where(real, 1.0, factor))
        wanted[real] = wanted[real].real
        try:
            yield factor, luenberger(A, C, wanted, dt)
        except SynthesisError:
            continue
