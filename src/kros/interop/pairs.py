"""Rows of recordings as pairs of a row and its next state."""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt

from ..core.errors import DataError
from .rows import Columns, episode_edges, finite, split_columns

Array = npt.NDArray[np.float64]


def one_step_pairs(X: Any, *, n_inputs: int = 0, episode_feature: bool = False) -> tuple[Any, Array, npt.NDArray[np.int64]]:
    """Return rows, their next states and their episode, which any splitter of scikit-learn may divide and shuffle.

    Splitting the rows of a recording cuts episodes, and joins what is left across the cut; pairs have no such seam.

    Parameters
    ----------
    X : array_like or DataFrame, shape (n_samples, n_columns)
        As in `KoopmanRegressor.fit`.
    n_inputs : int
    episode_feature : bool

    Returns
    -------
    now : ndarray or DataFrame, shape (n_pairs, n_states + n_inputs)
        Without the columns of episode and time.
    after : ndarray, shape (n_pairs, n_states)
    episode : ndarray, shape (n_pairs,)
        Number of the episode, for splitters that take groups.

    Raises
    ------
    DataError
        As `KoopmanRegressor.fit`.
    """
    columns = split_columns(X, episode_feature=episode_feature, time=None)
    values = _numbers(columns)
    n_states = values.shape[1] - n_inputs
    if n_inputs < 0 or n_states < 1:
        raise DataError(f"one_step_pairs: {values.shape[1]} columns cannot have {n_inputs} inputs; at least one column is a state.")
    finite(values, columns.names or [str(i) for i in range(values.shape[1])], "Input X")
    edges = episode_edges(columns, None, len(values))
    now = np.delete(np.arange(len(values)), edges[1:] - 1)
    rows = columns.values.iloc[now] if hasattr(columns.values, "iloc") else values[now]
    return rows, values[now + 1, :n_states], np.searchsorted(edges, now, side="right") - 1


def _numbers(columns: Columns) -> Array:
    try:
        return np.asarray(columns.values, dtype=np.float64)
    except (TypeError, ValueError) as error:
        raise DataError(
            f"one_step_pairs: the columns of states and inputs should hold numbers ({error}); convert or drop the others."
        ) from error
