"""Distances of units from one another, in dB relative to their typical size.

responses (unit, frequency, p, m) --residuals from every nominal--> scaled to typical entries of one --sigma_max,
smoothed--> levels in dB

Entries are scaled by their typical size over all pairs, frequency by frequency (Sinkhorn scaling of the median squared
magnitudes), so that every row and column of the residual counts alike.
"""

import numpy as np

from ...core import AnyArray, frozen
from ...core.linalg import pieces, sigma_max, squared
from ..forms import Form, evenly, residual
from ..settings import OUTLIER


@frozen
class Distances:
    """Distances of all units."""

    nominals: AnyArray  # (nominal,): rows of the units that were the nominal in turn
    peaks: AnyArray  # (nominal, unit), dB: largest level with one nominal; NaN against itself
    levels: AnyArray  # (unit, frequency), dB: smoothed singular value of the scaled residual, median over the nominals
    left: AnyArray  # (frequency, p'): typical size of the residual's rows
    right: AnyArray  # (frequency, m'): of its columns


def distances(form: Form, responses: AnyArray, freqs_hz: AnyArray) -> Distances:
    """Return the distances of all units, shape (unit, frequency, p, m), in scaled coordinates."""
    nominals = _nominals(responses)
    itself = nominals[:, None] == np.arange(len(responses))
    parts = pieces(responses.shape[1], OUTLIER.at_once // (itself.size * max(responses.shape[2:]) ** 2))
    sigma, left, right = zip(*(_scaled(form, responses[:, part], nominals, itself) for part in parts), strict=True)
    level = _levels(np.concatenate(sigma, axis=2), freqs_hz)
    level[itself] = np.nan
    median = np.nanmedian(level, axis=0)
    return Distances(nominals, level.max(axis=2), median, np.concatenate(left), np.concatenate(right))


def _scaled(form: Form, G: AnyArray, nominals: AnyArray, itself: AnyArray) -> tuple[AnyArray, AnyArray, AnyArray]:
    """Return singular values (nominal, unit, frequency) of residuals in units of their typical entries, and these."""
    E = np.stack([residual(form, G[k], G) for k in nominals])  # (nominal, unit, frequency, p', m')
    size = np.abs(G).max(axis=(2, 3))
    apart = np.stack([np.abs(G - G[k]).max(axis=(2, 3)) for k in nominals])
    E[apart <= OUTLIER.smallest * np.maximum(size, size[nominals][:, None])] = 0.0  # equal but for rounding
    squares = squared(E[~itself])
    middle = np.median(squares, axis=0)
    equal = middle.max(axis=(1, 2)) == 0  # most pairs are
    middle[equal] = squares[:, equal].mean(axis=0)
    left, right = typical(middle)
    return sigma_max(E / left[:, :, None] / right[:, None, :]), left, right


def scaled_levels(form: Form, nominal: AnyArray, perturbed: AnyArray, found: Distances, freqs_hz: AnyArray) -> AnyArray:
    """Return smoothed levels of residuals in the scales of a population, shape (..., frequency), dB."""
    E = residual(form, nominal, perturbed) / found.left[:, :, None] / found.right[:, None, :]
    return _levels(sigma_max(E), freqs_hz)


def typical(squares: AnyArray) -> tuple[AnyArray, AnyArray]:
    """Return left and right scales that bring squared entries to equal row and column sums."""
    row = squares.max(axis=2, keepdims=True)
    row = np.where(row > 0, row, 1.0)
    column = (squares / row).max(axis=1, keepdims=True)
    column = np.where(column > 0, column, 1.0)
    weights = np.maximum(squares / row / column, OUTLIER.smallest)
    left, right = np.ones(weights.shape[:2]), np.ones(weights.shape[::2])
    for _ in range(OUTLIER.balancings):
        left = (weights / right[:, None, :]).sum(axis=2)
        right = (weights / left[:, :, None]).sum(axis=1)
    return np.sqrt(left * row[:, :, 0]), np.sqrt(right * column[:, 0])


def _nominals(G: AnyArray) -> AnyArray:
    """All units, or 64 spread evenly over their distances from the entrywise median."""
    if len(G) <= OUTLIER.nominals:
        return np.arange(len(G))
    middle = np.median(G.real, axis=0) + 1j * np.median(G.imag, axis=0)
    size = np.maximum(np.abs(middle), np.finfo(float).tiny)
    order = np.argsort((np.abs(G - middle) / size).mean(axis=(1, 2, 3)), kind="stable")
    return np.sort(order[evenly(len(G), OUTLIER.nominals)])


def _levels(sigma: AnyArray, freqs: AnyArray) -> AnyArray:
    """Moving average of singular values in dB over log frequency, to a billionth of a dB."""
    level = 20 * np.log10(np.maximum(sigma, OUTLIER.least))
    x = np.log10(freqs)
    near = (np.abs(x[:, None] - x) <= OUTLIER.smoothing / 2).astype(float)
    return np.round(level @ (near / near.sum(axis=0)), 9)
