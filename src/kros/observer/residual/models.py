r"""The model of a residual-shaped observer: rows identified for free runs, or fitted to single steps.

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
from dataclasses import dataclass
from itertools import combinations

import numpy as np

from ...core.arrays import AnyArray, Array
from ...core.errors import DataError
from ...core.rounding import TINY
from ...data import EpisodeBatch
from ...lifting import Lifting
from ...synthesis.residual_shaped.residual_h2 import ResidualProblem, promised_errors
from .one_step import mean_error_dynamics, mean_slopes, one_step_residual, residual_spectra

_MOST_HIDDEN = 3  # beyond it, all hidden states or none are refitted
_THIN = 3


@dataclass(frozen=True, eq=False)
class ResidualModel:
    """A model for a residual-shaped observer, with what its synthesis needs."""

    refitted: tuple[int, ...]
    A: Array  # (n_lifted, n_lifted)
    B: Array  # (n_lifted, m)
    dynamics: Array  # (n, n)
    spectra: AnyArray  # (unit, f, n, n)
    promised: Array  # (n,)


def one_step_rows(lifting: Lifting, batch: EpisodeBatch) -> tuple[Array, Array]:
    """Fit the original states' rows of the model to single steps of all recordings by least squares."""
    h, lengths = lifting.history, batch.lengths
    x, u = np.swapaxes(batch.states, 0, 1), np.swapaxes(batch.inputs, 0, 1)
    values = {name: value[..., None] for name, value in batch.parameters.items()}
    window, u = lifting.windows(x, u)[:, :-1], u[:, h:-1]
    regressors = np.concatenate([lifting.lift(window, values), lifting.lift_inputs(u, window, values)], axis=-1)
    counted = np.arange(regressors.shape[1]) < (lengths - h - 1)[:, None]
    counted[:, np.arange(regressors.shape[1]) % _THIN != 0] = False
    regressors, following = regressors[counted], x[:, h + 1 :][counted]
    if len(regressors) < regressors.shape[1]:
        raise DataError(
            f"One-step rows: {regressors.shape[1]} coefficients need as many steps, found {len(regressors)}; record "
            "more."
        )
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
        promised = promised_errors(
            ResidualProblem(dynamics, np.eye(n)[list(measured)], chosen, noise, scale, batch.sample_period_s)
        )
        models.append(ResidualModel(rows, *model, dynamics, chosen, promised))
    return sorted(models, key=lambda m: float(np.sum(np.log(np.maximum(m.promised[hidden], TINY)))))


def _choices(measured: tuple[int, ...], hidden: Sequence[int]) -> list[tuple[int, ...]]:
    others = [i for i in hidden if i not in measured]
    sizes = range(len(others) + 1) if len(others) <= _MOST_HIDDEN else (0, len(others))
    return [(), *(tuple(sorted(measured + some)) for size in sizes for some in combinations(others, size))]


def least_squares(regressors: Array, values: Array, rcond: float | None = None) -> Array:
    """Return the smallest least-squares X of ``regressors X = values``, every regressor in units of its size."""
    largest = np.abs(regressors).max(axis=0, initial=0.0)
    largest[largest == 0] = 1.0
    size = largest * np.sqrt(np.mean((regressors / largest) ** 2, axis=0))
    size[size == 0] = 1.0
    return np.asarray(np.linalg.lstsq(regressors / size, values, rcond=rcond)[0] / size[:, None])
