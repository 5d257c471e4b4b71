"""Whether data determine a model, and how well a model predicts them."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import numpy.typing as npt

from ..core.errors import DataError, IdentificationError

Array = npt.NDArray[np.float64]

_DEPENDENT = 1e-13  # columns that are sums of others left relative pivots of 1e-18 to 2e-15 over 10 to 100 000 rows
_SCORED_ROWS = 2  # R2 compares with a mean
_ROUNDING = 1e-12


def check_excitation(R: Array, names: Sequence[str], n_states: int, n_lifted: int, n_pairs: int) -> None:
    """Name the first of the columns (states, lifted functions, inputs) that plain least squares cannot tell from those before it."""
    if n_pairs < len(names):
        raise DataError(
            f"Found n_samples = {n_pairs} transitions for {len(names)} unknowns of every row of [A B] "
            f"({', '.join(names)}); record more, lift less, or use alpha > 0."
        )
    norms = np.linalg.norm(R, axis=0)
    dependent = np.flatnonzero(np.abs(np.diagonal(R)) <= _DEPENDENT * norms)
    if dependent.size:
        j = int(dependent[0])
        kind = "state" if j < n_states else "lifted function" if j < n_lifted else "input"
        why = "is zero throughout" if norms[j] == 0 else f"depends on the columns before it ({', '.join(names[:j])})"
        raise IdentificationError(
            f"With alpha = 0 the {kind} {names[j]!r} cannot be identified: it {why}; remove it, excite it, or use alpha > 0."
        )


def r_squared(truth: Array, predicted: Array) -> float:
    """Return the mean R2 over the states; one that does not vary counts one where it is predicted to rounding, else zero."""
    truth, predicted = (values[:, None] if values.ndim == 1 else values for values in (truth, predicted))
    if truth.shape != predicted.shape:
        raise DataError(f"score: y has {truth.shape[1]} columns, the model has {predicted.shape[1]} states; y holds the next states.")
    if len(truth) < _SCORED_ROWS:
        raise DataError(
            f"score: found {len(truth)} samples to compare with, R2 needs {_SCORED_ROWS}; pass longer episodes, or lower the horizon."
        )
    if not np.isfinite(predicted).all():
        return -np.inf
    varies = np.ptp(truth, axis=0) > 0
    error = np.sum((predicted - truth) ** 2, axis=0)
    spread = np.sum((truth - truth.mean(axis=0)) ** 2, axis=0)
    rounding = len(truth) * (_ROUNDING * np.abs(truth).max(axis=0)) ** 2
    return float(np.mean(np.where(varies, 1 - error / np.where(varies, spread, 1.0), error <= rounding)))
