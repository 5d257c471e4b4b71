r"""One-step residuals: what drives the error of an observer that retracts and lifts its state at every step.

Let the nominal's one-step model be :math:`x^+ = f(x, u) = A_s x + a\,\sigma(x) + B_s u`, the first n rows of the lifted
model. Along any recording

.. math:: \omega_k = x_{k+1} - f(x_k, u_k)

does not depend on the observer, and holds everything that the model does not know: the unit's own parameters, loads,
the lifting's error. The deployed error obeys, exactly, ``e+ = (A_s + a delta_k) e - y^c + omega_k`` with ``delta_k``
between the slopes of the lifted functions. **Only the rows of the original states drive it**: the lifted functions are
computed again from the states at every step, so their rows of the model, and what these rows miss, never enter. The
linear time-invariant stand-in for the error dynamics takes the mean of ``delta_k`` over the recordings. Where functions
oscillate as the machine moves, as ``sin(100 position + phase)`` does, that mean is nearly zero.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from ...core.arrays import Array, ArrayLike
from ...core.errors import DataError
from ...lifting import Lifting

SEGMENT = 4096
FEWEST_SAMPLES = 64  # samples of a segment


def one_step_residual(
    lifting: Lifting,
    A: Array,
    B: Array,
    states: Array,
    inputs: Array,
    parameters: Mapping[str, ArrayLike] | None = None,
) -> Array:
    """Run the one-step model along recordings and return what it misses; A (n_lifted, n_lifted), B (n_lifted, m)."""
    n, h = lifting.n_states, lifting.history
    lifting.window.require(len(states), beyond=1)
    x, u = np.swapaxes(states, 0, 1), np.swapaxes(inputs, 0, 1)
    values = {name: np.asarray(value, dtype=float)[..., None] for name, value in (parameters or {}).items()}
    window, u = lifting.windows(x, u)[:, :-1], u[:, h:-1]
    predicted = lifting.lift(window, values) @ A[:n].T + lifting.lift_inputs(u, window, values) @ B[:n].T
    return np.swapaxes(x[:, h + 1 :] - predicted, 0, 1)


def mean_slopes(
    lifting: Lifting, states: Array, inputs: Array, parameters: Mapping[str, ArrayLike] | None = None
) -> Array:
    """Return the lifted functions' slopes by the states at their mean over recordings, shape (p, n)."""
    n = lifting.n_states
    if not lifting.functions:
        return np.zeros((0, n))
    values = {name: np.asarray(value, dtype=float)[..., None] for name, value in (parameters or {}).items()}
    slopes = lifting.slopes(lifting.windows(np.swapaxes(states, 0, 1), np.swapaxes(inputs, 0, 1)), values)[..., :n]
    return np.asarray(slopes.mean(axis=(0, 1)))


def mean_error_dynamics(A: Array, slopes: Array) -> Array:
    """Return the dynamics of the deployed error, (n, n), of a model with slopes of shape (p, n)."""
    n = slopes.shape[1]
    return np.asarray(A[:n, :n] + A[:n, n:] @ slopes)


def one_step_covariance(residual: Array, lengths: ArrayLike) -> Array:
    """Return the mean product of residuals (n_samples, batch, n) over all episodes, shape (n, n)."""
    counted = residual[np.arange(len(residual))[:, None] < np.asarray(lengths)]
    return np.asarray(counted.T @ counted / len(counted))


def residual_spectra(residual: Array, lengths: ArrayLike, units: Sequence[str], segment: int = SEGMENT) -> Array:
    """Return every unit's cross spectral density of the residual by Welch's method, means included."""
    lengths = np.asarray(lengths, dtype=int)
    size = int(min(segment, lengths.min(), len(residual)))
    if size < FEWEST_SAMPLES:
        raise DataError(
            f"Residual spectra: an episode of unit {units[int(lengths.argmin())]} has {size} samples, at least "
            f"{FEWEST_SAMPLES} are needed; leave short episodes out."
        )
    size -= size % 2
    hann = np.sin(np.pi * np.arange(size) / size) ** 2
    hann /= np.sqrt(size * np.mean(hann**2))
    n = residual.shape[2]
    total = np.zeros((residual.shape[1], size // 2 + 1, n, n), complex)
    counts = np.zeros(residual.shape[1])
    for start in range(0, len(residual) - size + 1, size // 2):
        inside = np.flatnonzero(start + size <= lengths)
        response = np.moveaxis(np.fft.rfft(residual[start : start + size, inside] * hann[:, None, None], axis=0), 0, 1)
        total[inside] += response[..., :, None] * response[..., None, :].conj()
        counts[inside] += 1
    if not np.isfinite(total).all():
        raise DataError(
            "Residual spectra: the residual contains NaN or infinity; look at the recordings and the nominal model."
        )
    names = list(dict.fromkeys(units))
    member = np.array([[u == name for u in units] for name in names], dtype=float)
    return np.asarray(np.einsum("ub,bfij->ufij", member / (member @ counts)[:, None], total))
