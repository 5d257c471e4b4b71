r"""Static gains of one machine: how the slow part of its states follows the slow part of its inputs.

Episodes are cut into blocks of T samples. A linear machine ``x+ = A x + B u`` obeys, block by block, exactly

.. math:: \bar x = G\, \bar u + (A - I)^{-1} \frac{x_T - x_0}{T}, \qquad G = (I - A)^{-1} B,

so that over the means of all blocks :math:`\bar x = G \bar u + L\, \Delta x + c` is fitted by least squares: a leakage or a worn transmission shows in G, and
hardly in a distance of models that weighs all frequencies. What is fast and nonlinear averages out. A state that is the integral of an input, such as an angle
beside the reference of its rate, has no static gain from it; its changes are left out of the fit, and what others do at a constant rate is their gain.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

Array = npt.NDArray[np.float64]
FEWEST = 3  # blocks beyond the unknowns
_EXCITED = 0.01  # of its range, what an input's slow part has to vary by
_INTEGRAL = 0.9  # correlation of a state's change with an input's mean
_APART = 1e-2  # smallest singular value of inputs of unit size, relative to the largest: of less, gains are not told apart


@dataclass(frozen=True, eq=False)
class StaticGains:
    """Static gains with their uncertainty.

    Parameters
    ----------
    gains, deviations : ndarray, shape (n, m)
        NaN where the motion does not tell.
    explained : ndarray, shape (n,)
        Share of the variance of every state's slow part that inputs and changes explain.
    blocks : int
    """

    gains: Array
    deviations: Array
    explained: Array
    blocks: int


def static_gains(states: Sequence[Array], inputs: Sequence[Array], block: int, ranges: Array) -> StaticGains:
    """Fit static gains to episodes of one machine.

    Parameters
    ----------
    states, inputs : sequence of ndarray, shape (n_samples, n) and (n_samples, m)
        Of every episode. A block in which a sample is not finite does not count.
    block : int
        Samples of a block.
    ranges : ndarray, shape (m,)
        Of the inputs: one whose slow part varies by less than a hundredth of it tells nothing.

    Returns
    -------
    StaticGains

    Examples
    --------
    >>> import numpy as np
    >>> from kros.identify.static_gains import static_gains
    >>> u = np.repeat(np.array([0.0, 1.0, 3.0, 2.0, -1.0, 0.5]), 50)[:, None]
    >>> static_gains([0.8 * u + 0.1], [u], 50, np.array([3.0])).gains.round(6).tolist()
    [[0.8]]
    """
    n, m = states[0].shape[1], inputs[0].shape[1]
    x, u = (np.concatenate([_means(values, block) for values in signals]) for signals in (states, inputs))
    change = np.concatenate([_changes(values, block) for values in states])
    finite = np.isfinite(x).all(axis=1) & np.isfinite(u).all(axis=1) & np.isfinite(change).all(axis=1)
    x, u, change = x[finite], u[finite], change[finite]
    unknown = StaticGains(np.full((n, m), np.nan), np.full((n, m), np.nan), np.full(n, np.nan), len(x))
    if len(x) < n + m + 1 + FEWEST:
        return unknown
    x, u, change = x - x.mean(axis=0), u - u.mean(axis=0), change - change.mean(axis=0)
    told = np.sqrt(np.mean(u**2, axis=0)) > _EXCITED * ranges
    if not told.any():
        return unknown
    own = _orthogonal(change[:, ~_integrals(change, u[:, told])])
    x, u, variance = x - own @ (own.T @ x), u - own @ (own.T @ u), (x**2).sum(axis=0)
    size = np.sqrt(np.mean(u**2, axis=0))
    left, values, right = np.linalg.svd(u[:, told] / size[told], full_matrices=False)
    kept = values > _APART * values[0]
    inverse = (right[kept].T / values[kept]) @ left[:, kept].T
    gains = np.full((n, m), np.nan)
    gains[:, told] = (inverse @ x).T / size[told]
    rest = x - left[:, kept] @ (left[:, kept].T @ x)
    free = len(x) - 1 - int(kept.sum()) - own.shape[1]
    noise, spread = np.sqrt((rest**2).sum(axis=0) / free), np.sqrt((inverse**2).sum(axis=1)) / size[told]
    deviations = np.full((n, m), np.nan)
    deviations[:, told] = noise[:, None] * spread
    mixed = np.zeros(m, dtype=bool)
    mixed[told] = np.abs(right[~kept]).max(axis=0, initial=0.0) > 0.1
    gains[:, mixed] = deviations[:, mixed] = np.nan
    explained = 1 - np.divide((rest**2).sum(axis=0), variance, out=np.ones(n), where=variance > 0)
    return StaticGains(gains, deviations, explained, len(x))


def _means(values: Array, block: int) -> Array:
    """Means of whole blocks, shape (blocks, channels)."""
    count = len(values) // block
    return np.asarray(values[: count * block].reshape(count, block, -1).mean(axis=1))


def _changes(values: Array, block: int) -> Array:
    """From the first sample of every block to that of the next one, over its length, shape (blocks, channels); not a number behind the last sample."""
    count = len(values) // block
    edges = np.full((count + 1, values.shape[1]), np.nan)
    known = values[: count * block + 1 : block]
    edges[: len(known)] = known
    if len(values) == count * block and count:
        edges[-1] = values[-1]
    return np.asarray(np.diff(edges, axis=0) / block)


def _integrals(change: Array, u: Array) -> npt.NDArray[np.bool_]:
    """Whether every state is the integral of an input, shape (n,)."""
    sizes = np.sqrt((change**2).sum(axis=0))[:, None] * np.sqrt((u**2).sum(axis=0))
    along = np.divide(np.abs(change.T @ u), sizes, out=np.zeros(sizes.shape), where=sizes > 0)
    return np.asarray((along > _INTEGRAL).any(axis=1) | (change == 0).all(axis=0))


def _orthogonal(columns: Array) -> Array:
    """An orthonormal basis of what columns span, shape (rows, rank)."""
    size = np.sqrt((columns**2).sum(axis=0))
    left, values, _ = np.linalg.svd(columns / size, full_matrices=False)
    return np.asarray(left[:, values > _APART * values.max(initial=0.0)])
