r"""One-step residuals, which drive the error of an observer that lifts its state anew, and models shaped by them.

Let the nominal's one-step model be :math:`x^+ = f(x, u) = A_s x + a\,\sigma(x) + B_s u`, the first n rows of the lifted
model. Along any recording

.. math:: \omega_k = x_{k+1} - f(x_k, u_k)

does not depend on the observer, and holds everything that the model does not know: the unit's own parameters, loads,
the lifting's error. The deployed error obeys, exactly, ``e+ = (A_s + a delta_k) e - y^c + omega_k`` with ``delta_k``
between the slopes of the lifted functions. **Only the rows of the original states drive it**: the lifted functions are
computed again from the states at every step, so their rows of the model, and what these rows miss, never enter. The
linear time-invariant stand-in for the error dynamics takes the mean of ``delta_k`` over the recordings. Where functions
oscillate as the machine moves, as ``sin(100 position + phase)`` does, that mean is nearly zero.

Models that are refined for long free runs predict well as a whole, and their rows may be poor by themselves: on drives
the position of the next sample is missed by a hundred times more than a row fitted by least squares to single steps
misses it, and a filter has to undo that from the measurement. The rows of lifted models are independent in the one-step
residual, so every choice of rows comes from two residuals,

    omega_i = x_i(k + 1) - [A_i | B_i] [theta(x); u]          with [A_i | B_i] as identified, or by least squares.

Choices are ordered by the error that the Kalman predictor for their measured spectra promises; nothing has to be
simulated for that. A model with rows of both kinds is no member of any uncertain set, and need not be stable by itself:
the correction makes the observer stable.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import combinations

import numpy as np

from ..core import TINY, Array, ArrayLike, Columns, DataError, Parameters, Record, frozen
from ..data import EpisodeBatch
from ..lifting import Lifting
from ..synthesis.residual_shaped.residual_h2 import ResidualProblem, promised_errors

SEGMENT = 4096
FEWEST_SAMPLES = 64  # samples of a segment
_MOST_HIDDEN = 3  # beyond it, all hidden states or none are refitted
_THIN = 3


def one_step_residual(
    lifting: Lifting,
    A: Array,
    B: Array,
    states: Array,
    inputs: Array,
    parameters: Parameters | None = None,
) -> Array:
    """Run the one-step model along recordings and return what it misses; A (n_lifted, n_lifted), B (n_lifted, m)."""
    n, h = lifting.n_states, lifting.history
    lifting.window.require(len(states), beyond=1)
    window, u, values = _windows(lifting, states, inputs, parameters)
    lifted, widened = lifting.lift(window[:, :-1], values), lifting.lift_inputs(u[:, :-1], window[:, :-1], values)
    return states[h + 1 :] - np.swapaxes(lifted @ A[:n].T + widened @ B[:n].T, 0, 1)


def mean_slopes(lifting: Lifting, states: Array, inputs: Array, parameters: Parameters | None = None) -> Array:
    """Return the lifted functions' slopes by the states at their mean over recordings, shape (p, n)."""
    window, _, values = _windows(lifting, states, inputs, parameters)
    return lifting.slopes(window, values)[..., : lifting.n_states].mean(axis=(0, 1))


def _windows(
    lifting: Lifting, states: Array, inputs: Array, parameters: Parameters | None
) -> tuple[Array, Array, dict[str, Array]]:
    """Return windows, inputs and parameters of recordings, the batch first and time second."""
    x, u = np.swapaxes(states, 0, 1), np.swapaxes(inputs, 0, 1)
    values = {name: np.asarray(value, dtype=float)[..., None] for name, value in (parameters or {}).items()}
    return lifting.windows(x, u), u[:, lifting.history :], values


def mean_error_dynamics(A: Array, slopes: Array) -> Array:
    """Return the dynamics of the deployed error, (n, n), of a model with slopes of shape (p, n)."""
    n = slopes.shape[1]
    return A[:n, :n] + A[:n, n:] @ slopes


def residual_covariance(lifting: Lifting, A: Array, B: Array, batch: EpisodeBatch) -> Array:
    """Return the mean product of one-step residuals (n_samples, batch, n) over all episodes, shape (n, n)."""
    residual = one_step_residual(lifting, A, B, batch.states, batch.inputs, batch.parameters)
    counted = residual[np.arange(len(residual))[:, None] < batch.lengths - 1 - lifting.history]
    return counted.T @ counted / len(counted)


def like_measurement_noise(covariance: Array, R: Array) -> float:
    """Return the factor that brings a covariance of the measurements to the size of their noise R."""
    return 1.0 / max(float(np.mean(np.diag(covariance) / np.diag(R))), TINY)


def residual_spectra(residual: Array, lengths: ArrayLike, units: Sequence[str], segment: int = SEGMENT) -> Array:
    """Return every unit's cross spectral density of the residual by Welch's method, means included."""
    from scipy.signal import csd

    lengths = np.asarray(lengths, dtype=int)
    size = int(min(segment, lengths.min(), len(residual)))
    if size < FEWEST_SAMPLES:
        raise DataError(
            f"Residual spectra: an episode of unit {units[int(lengths.argmin())]} has {size} samples, at least "
            f"{FEWEST_SAMPLES} are needed; leave short episodes out."
        )
    size -= size % 2
    x = [residual[:length, i].T for i, length in enumerate(lengths.tolist())]
    options: Record = {"nperseg": size, "detrend": False, "return_onesided": False}
    total = np.moveaxis(
        np.array([csd(one[None], one[:, None], **options)[1][..., : size // 2 + 1] for one in x]), -1, 1
    )
    if not np.isfinite(total).all():
        raise DataError(
            "Residual spectra: a residual is NaN or infinity; look at the recordings and the nominal model."
        )
    member = np.array([[u == name for u in units] for name in dict.fromkeys(units)])
    counts = member * (lengths // (size // 2) - 1)  # segments
    return np.einsum("ub,bfij->ufij", counts / counts.sum(axis=1, keepdims=True), total)


@frozen
class ResidualModel:
    """A model for a residual-shaped observer, with what its synthesis needs."""

    refitted: tuple[int, ...]
    A: Array  # (n_lifted, n_lifted)
    B: Array  # (n_lifted, m)
    problem: ResidualProblem
    promised: Array  # (n,)


def one_step_rows(lifting: Lifting, batch: EpisodeBatch) -> tuple[Array, Array]:
    """Fit the original states' rows of the model to single steps of all recordings by least squares."""
    h = lifting.history
    window, u, values = _windows(lifting, batch.states, batch.inputs, batch.parameters)
    window, u = window[:, :-1], u[:, :-1]
    regressors = np.concatenate([lifting.lift(window, values), lifting.lift_inputs(u, window, values)], axis=-1)
    counted = np.arange(regressors.shape[1]) < (batch.lengths - h - 1)[:, None]
    counted[:, np.arange(regressors.shape[1]) % _THIN != 0] = False
    regressors, following = regressors[counted], np.swapaxes(batch.states[h + 1 :], 0, 1)[counted]
    if len(regressors) < regressors.shape[1]:
        raise DataError(f"One-step rows: {regressors.shape[1]} coefficients, but {len(regressors)} steps; record more.")
    W = least_squares(regressors, following).T
    return W[:, : lifting.n_lifted], W[:, lifting.n_lifted :]


def with_rows(A: Array, B: Array, A_s: Array, B_s: Array, rows: Sequence[int] | None = None) -> tuple[Array, Array]:
    """Return a model with some of its first rows, all by default, taken from another one."""
    rows = list(range(len(A_s)) if rows is None else rows)
    A, B = A.copy(), B.copy()
    A[rows], B[rows] = A_s[rows], B_s[rows]
    return A, B


def residual_models(
    lifting: Lifting,
    A: Array,
    B: Array,
    measured: Sequence[int],
    batch: EpisodeBatch,
    noise: Array,
    scale: Array,
) -> list[ResidualModel]:
    """Return models with rows of both kinds, the one that promises the smallest hidden errors first."""
    n, x, u, values = lifting.n_states, batch.states, batch.inputs, batch.parameters
    hidden = [i for i in range(n) if i not in measured] or list(range(n))
    fitted = one_step_rows(lifting, batch)
    both = [one_step_residual(lifting, *model, x, u, values) for model in ((A, B), with_rows(A, B, *fitted))]
    spectra = residual_spectra(np.concatenate(both, axis=-1), batch.lengths - 1 - lifting.history, batch.units)
    models, slopes = [], mean_slopes(lifting, x, u, values)
    for rows in _choices(tuple(measured), hidden):
        model, columns = with_rows(A, B, *fitted, rows), [i + n * (i in rows) for i in range(n)]
        dynamics, chosen = mean_error_dynamics(model[0], slopes), spectra[..., columns, :][..., columns]
        C, period = np.eye(n)[list(measured)], batch.sample_period_s
        problem = ResidualProblem(dynamics, C, chosen, noise, scale, period)
        models.append(ResidualModel(rows, *model, problem, promised_errors(problem)))
    return sorted(models, key=lambda m: float(np.sum(np.log(np.maximum(m.promised[hidden], TINY)))))


def _choices(measured: Columns, hidden: Sequence[int]) -> list[tuple[int, ...]]:
    others = [i for i in hidden if i not in measured]
    sizes = range(len(others) + 1) if len(others) <= _MOST_HIDDEN else (0, len(others))
    return [(), *(tuple(sorted(measured + some)) for size in sizes for some in combinations(others, size))]


def least_squares(regressors: Array, values: Array) -> Array:
    """Return the smallest least-squares X of ``regressors X = values``, each regressor over its largest value."""
    size = np.abs(regressors).max(axis=0, initial=0.0)
    size[size == 0] = 1.0
    return np.linalg.lstsq(regressors / size, values, rcond=None)[0] / size[:, None]
