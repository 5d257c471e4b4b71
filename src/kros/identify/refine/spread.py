"""How far the models of a population are apart, as the uncertainty of the population will count it."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

Array = npt.NDArray[np.float64]
_POINTS = 200
_DECADES_BELOW_NYQUIST = 6


def peak_residual_db(A: Array, B: Array, output_scale: Array, input_scale: Array, points: int = _POINTS) -> float:
    """Return the peak of the inverse input multiplicative residual ``G^+ (G_nominal - G)`` for the nominal unit that makes it smallest.

    Parameters
    ----------
    A : ndarray, shape (unit, n, n)
        Stable.
    B : ndarray, shape (unit, n, m)
    output_scale : ndarray, shape (n,)
    input_scale : ndarray, shape (m,)
    points : int
        Frequencies.

    Returns
    -------
    float, dB
        NaN for fewer than two units.
    """
    if len(A) < 2:
        return float("nan")
    z = np.exp(1j * np.pi * np.logspace(-_DECADES_BELOW_NYQUIST, 0, points))
    G = np.linalg.solve(z[:, None, None] * np.eye(A.shape[-1]) - A[:, None], B[:, None] + 0j) * input_scale / output_scale[:, None]
    inverse = np.linalg.pinv(G)
    peaks = [np.linalg.norm(inverse @ (G[row] - G), ord=2, axis=(-2, -1)).max() for row in range(len(G))]
    with np.errstate(divide="ignore"):
        return float(20 * np.log10(min(peaks)))
