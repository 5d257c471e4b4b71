r"""Static gains of one machine: how the slow part of its states follows the slow part of its inputs.

Episodes are cut into blocks, and over the means of all blocks

.. math:: \bar x = G\, \bar u + c

is fitted by least squares. A block is long against what the machine does by itself, and what is faster averages out: a leakage or a worn transmission shows
in G, and hardly in the distance of models that weighs all frequencies. Where blocks are not much longer than the slowest time constant G is not quite that at
rest, but that of one kind of motion, alike for all machines that move so.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

Array = npt.NDArray[np.float64]
FEWEST = 3  # blocks beyond the unknowns
_EXCITED = 0.01  # of its range, what an input's slow part has to vary by
_APART = 1e-2  # smallest singular value of inputs of unit size, relative to the largest: of less, gains are not told apart


@dataclass(frozen=True, eq=False)
class StaticGains:
    """Static gains with their uncertainty.

    Parameters
    ----------
    gains, deviations : ndarray, shape (n, m)
        NaN where the motion does not tell.
    explained : ndarray, shape (n,)
        Share of the variance of every state's slow part that the inputs explain.
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
    finite = np.isfinite(x).all(axis=1) & np.isfinite(u).all(axis=1)
    x, u = x[finite], u[finite]
    unknown = StaticGains(np.full((n, m), np.nan), np.full((n, m), np.nan), np.full(n, np.nan), len(x))
    if len(x) < m + 1 + FEWEST:
        return unknown
    x, u = x - x.mean(axis=0), u - u.mean(axis=0)
    size = np.sqrt(np.mean(u**2, axis=0))
    told = size > _EXCITED * ranges
    if not told.any():
        return unknown
    left, values, right = np.linalg.svd(u[:, told] / size[told], full_matrices=False)
    kept = values > _APART * values[0]
    inverse = (right[kept].T / values[kept]) @ left[:, kept].T
    gains = np.full((n, m), np.nan)
    gains[:, told] = (inverse @ x).T / size[told]
    rest = x - left[:, kept] @ (left[:, kept].T @ x)
    free = len(x) - 1 - int(kept.sum())
    noise, spread = np.sqrt((rest**2).sum(axis=0) / free), np.sqrt((inverse**2).sum(axis=1)) / size[told]
    deviations = np.full((n, m), np.nan)
    deviations[:, told] = noise[:, None] * spread
    mixed = np.zeros(m, dtype=bool)
    mixed[told] = np.abs(right[~kept]).max(axis=0, initial=0.0) > 0.1
    gains[:, mixed] = deviations[:, mixed] = np.nan
    variance = (x**2).sum(axis=0)
    explained = 1 - np.divide((rest**2).sum(axis=0), variance, out=np.ones(n), where=variance > 0)
    return StaticGains(gains, deviations, explained, len(x))


def _means(values: Array, block: int) -> Array:
    """Means of whole blocks, shape (blocks, channels)."""
    count = len(values) // block
    return np.asarray(values[: count * block].reshape(count, block, -1).mean(axis=1))
