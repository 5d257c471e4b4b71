r"""Mean of a spectral density over the unit circle, when it spans many decades of frequency.

.. math:: \frac{1}{2\pi}\int_{-\pi}^{\pi} f(\theta)\,d\theta = \frac{1}{\pi}\int_0^{\pi} f(\theta)\,d\theta

for an even density. The interval is cut into panels, logarithmic in frequency and refined around given frequencies (the
poles), with a linear panel at DC. Each panel carries the Gauss-Legendre rules of 7 and 10 points; panels where these
disagree most are halved.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import numpy.typing as npt

from ...core.errors import SynthesisError

Array = npt.NDArray[Any]

_NODES, _WEIGHTS = np.polynomial.legendre.leggauss(10)
_ROUGH_NODES, _ROUGH_WEIGHTS = np.polynomial.legendre.leggauss(7)
_ALL = np.concatenate([_NODES, _ROUGH_NODES])


def circle_mean(
    density: Callable[[Array], Array], centers: Array, rtol: float = 1e-6, max_panels: int = 4000
) -> tuple[float, float]:
    """Return the mean over the unit circle of an even, non-negative density, and an estimate of its error.

    `density` takes angles, shape (k,), and returns values, shape (k,); `centers` are logarithms of the poles, which
    place the first panels.
    """
    edges = _edges(centers)
    left, right = edges[:-1], edges[1:]
    values, errors = _panels(density, left, right)
    while errors.sum() > rtol * values.sum():
        if len(values) > max_panels:
            raise SynthesisError(
                f"Integrating the spectral density: relative error {errors.sum() / values.sum():.2g} after "
                f"{len(values)} panels, asked for {rtol:.2g}; "
                "a weight or the loop has poles extremely close to the unit circle."
            )
        split = errors > min(0.5 * errors.max(), rtol * values.sum() / len(values))
        middle = np.where(left[split] > 0, np.sqrt(left[split] * right[split]), right[split] / 4)
        new_left = np.concatenate([left[split], middle])
        new_right = np.concatenate([middle, right[split]])
        new_values, new_errors = _panels(density, new_left, new_right)
        left, right = np.concatenate([left[~split], new_left]), np.concatenate([right[~split], new_right])
        values, errors = np.concatenate([values[~split], new_values]), np.concatenate([errors[~split], new_errors])
    return float(values.sum() / np.pi), float(errors.sum() / np.pi)


def _edges(centers: Array) -> Array:
    """Panel edges: three a decade, and a row of widths around each pole's angle."""
    angle, width = np.abs(centers.imag), np.abs(centers.real)
    size = np.hypot(angle, width)
    low = min(max(1e-2 * size.min(initial=np.pi), 1e-12), 1e-3)
    widths = np.concatenate([-(4.0 ** np.arange(8)), [0.0], 4.0 ** np.arange(8)])
    around = (angle[:, None] + width[:, None] * widths).ravel()
    around = around[(around > low) & (around < np.pi)]
    edges = np.unique(np.concatenate([np.geomspace(low, np.pi, 2 + int(3 * np.log10(np.pi / low))), around]))
    apart = np.concatenate([[True], np.diff(np.log(edges)) > 1e-9])
    return np.concatenate([[0.0], edges[apart]])


def _panels(density: Callable[[Array], Array], left: Array, right: Array) -> tuple[Array, Array]:
    """Both rules on every panel; logarithmic inside, linear in the panel that touches DC."""
    linear = left <= 0
    log_left = np.log(np.where(linear, 1.0, left))
    log_right = np.where(linear, 0.0, np.log(right))
    middle, half = (log_left + log_right) / 2, (log_right - log_left) / 2
    angles = np.exp(middle[:, None] + half[:, None] * _ALL)
    angles[linear] = right[linear, None] * (1 + _ALL) / 2
    values = density(angles.ravel()).reshape(angles.shape)
    if not np.isfinite(values).all():
        raise SynthesisError(
            "Integrating the spectral density: it is not finite; is the uncertain set well posed and the loop stable?"
        )
    weighted = np.where(linear[:, None], values * right[:, None] / 2, values * angles * half[:, None])
    integral = weighted[:, : len(_NODES)] @ _WEIGHTS
    return integral, np.abs(integral - weighted[:, len(_NODES) :] @ _ROUGH_WEIGHTS)
