"""Triangular factors: each episode is reduced once, all least squares after that is algebra on small matrices.

The factor of an episode is R of the QR decomposition of ``[x g u | x+ g+]``: states, parameter-free lifted functions and inputs at
k, states and functions at k + 1. Factors of several episodes combine by stacking and another QR (TSQR), so memory does not
grow with the recording and the condition number is never squared, as it is in (32)-(33).

Symbols
-------
x, u : states (n_samples, n) and inputs (n_samples, m)
g    : parameter-free functions, sigma(x; q) = M(q) g(x) (see `lifting.Separation`)
R    : upper triangular factor, (n_columns, n_columns)
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from ..core.linalg import qr_triangle
from ..lifting import Lifting

Array = npt.NDArray[np.float64]
_BLOCK_ROWS = 1024  # a block of this many rows stays in cache


@dataclass(frozen=True, eq=False)
class Factor:
    """Reduced data of one or more episodes, or a batch of such reductions.

    Parameters
    ----------
    R : ndarray, shape (..., n_columns, n_columns)
    peak : ndarray, shape (..., n + n_basis + m)
        Largest magnitude of every column at k.
    n_samples : ndarray, shape (...)
    """

    R: Array
    peak: Array
    n_samples: npt.NDArray[np.int64]


def reduce_episode(x: Array, u: Array, lifting: Lifting) -> Factor:
    """Reduce one episode to its factor.

    Parameters
    ----------
    x : ndarray, shape (n_samples, n)
    u : ndarray, shape (n_samples, m)
    lifting : Lifting

    Returns
    -------
    Factor
    """
    g = lifting.separation.evaluate(x)
    now = np.concatenate([x, g, u], axis=1)
    after = now[1:, : x.shape[1] + g.shape[1]]
    data = np.concatenate([now[:-1], after], axis=1)
    return Factor(triangular(data), np.abs(now).max(axis=0), np.asarray(len(data)))


def triangular(rows: Array) -> Array:
    """Return R of the QR decomposition of a tall matrix, by cache-sized blocks."""
    n_blocks, width = len(rows) // _BLOCK_ROWS, rows.shape[1]
    if n_blocks > 1:
        head = rows[: n_blocks * _BLOCK_ROWS].reshape(n_blocks, _BLOCK_ROWS, width)
        rows = np.concatenate([qr_triangle(head).reshape(-1, width), rows[n_blocks * _BLOCK_ROWS :]])
    R = qr_triangle(rows)
    return np.concatenate([R, np.zeros((width - len(R), width))]) if len(R) < width else R


def combine(factors: Factor) -> Factor:
    """Combine a batch of factors over its last batch axis, shape (..., episode, n, n) to (..., n, n)."""
    *batch, episodes, width, _ = factors.R.shape
    stacked = factors.R.reshape(*batch, episodes * width, width)
    return Factor(qr_triangle(stacked), factors.peak.max(axis=-2), factors.n_samples.sum(axis=-1))


def lifted_factor(factor: Factor, lifting: Lifting, parameters: dict[str, Array], model: Lifting) -> Factor:
    """Turn parameter-free factors into factors of ``[Psi | Theta_plus]`` for a model's own lifting.

    Parameters
    ----------
    factor : Factor
        Batch over units.
    lifting : Lifting
        The lifting that the factors were reduced with.
    parameters : dict of ndarray, shape (unit,)
    model : Lifting
        The model's lifting: that lifting itself, or the linear one with the same states.
    """
    n, b = lifting.n_states, len(lifting.separation.basis)
    n_inputs = factor.R.shape[-1] - 2 * (n + b)
    batch = factor.R.shape[:-2]
    theta = np.zeros((*batch, n + b, model.n_lifted))  # columns of theta in terms of [x g]
    theta[..., range(n), range(n)] = 1.0
    if model.functions:
        M = lifting.separation.matrix(parameters)
        theta[..., n:, n:] = np.swapaxes(M, -1, -2)
    width = model.n_lifted + n_inputs
    change = np.zeros((*batch, factor.R.shape[-1], width + model.n_lifted))
    change[..., : n + b, : model.n_lifted] = theta
    change[..., n + b : n + b + n_inputs, model.n_lifted : width] = np.eye(n_inputs)
    change[..., n + b + n_inputs :, width:] = theta
    peak = np.concatenate([factor.peak[..., :n], np.ones((*batch, model.n_lifted - n)), factor.peak[..., n + b :]], axis=-1)
    if model.functions:
        peak[..., n : model.n_lifted] = np.einsum("...ij,...j->...i", np.abs(M), factor.peak[..., n : n + b])
    return Factor(qr_triangle(factor.R @ change), peak, factor.n_samples)
