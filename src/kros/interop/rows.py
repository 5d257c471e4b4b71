"""Rows of recordings as scikit-learn passes them: one array or frame, with or without columns of episode and time.

    X ── split_columns ──► Columns (episode ids, time, values) ── episode_edges ──► where episodes begin

Nothing is sorted and no id passes through floating point on its way here, so two large ids never become one.
"""

from __future__ import annotations

import logging
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Any

import numpy as np
import numpy.typing as npt

from ..core.errors import DataError

log = logging.getLogger(__name__)
Array = npt.NDArray[np.float64]
Objects = npt.NDArray[Any]

EPISODE = "episode"
_BITS = 53  # from 2**53 on neighbouring whole numbers share a float64
_STEP_TOLERANCE = 1e-3  # deviation of one time step from the median, relative


@dataclass(frozen=True, eq=False)
class Columns:
    """Rows split by what their columns mean.

    Parameters
    ----------
    values : array_like, shape (n_samples, n_states + n_inputs)
        Not yet checked.
    names : tuple of str or None
        Names of these columns, from a frame.
    episodes : ndarray, shape (n_samples,), or None
        Ids, as whole numbers or text.
    time : ndarray, shape (n_samples,), or None
    index : ndarray, shape (n_samples,), or None
        Whole-number index of a frame, which shows rows that were left out.
    """

    values: Any
    names: tuple[str, ...] | None
    episodes: Objects | None = None
    time: Array | None = None
    index: Array | None = None


def split_columns(X: Any, *, episode_feature: bool, time: str | int | None) -> Columns:
    """Split rows into ids, time and values.

    Parameters
    ----------
    X : array_like or DataFrame, shape (n_samples, n_columns)
        In an array the episode is the first column (where `episode_feature` says that there is one); in a frame the column
        named ``episode`` wherever it stands, else the first one.
    episode_feature : bool
    time : str or int, optional
        Name or position of the column of time.

    Returns
    -------
    Columns

    Raises
    ------
    DataError
        A column that is not there, ids that are neither text nor exact whole numbers, time that is not finite.
    """
    frame = hasattr(X, "iloc") and hasattr(X, "columns")
    named = list(X.columns) if frame else None
    table: Any = X if frame else _table(X)
    n_columns = table.shape[1]
    episode_at = _episode_position(named, episode_feature)
    time_at = None if time is None else _time_position(time, named, n_columns)
    if episode_at is not None and episode_at == time_at:
        raise DataError(f"Column {time!r} is given as time, but holds the episode; name another column, or set episode_feature = False.")
    kept = [i for i in range(n_columns) if i not in (episode_at, time_at)]
    if not kept:
        raise DataError(f"Rows with {n_columns} columns hold no state beside episode and time; add the columns of states and inputs.")

    def column(i: int) -> Objects:
        return table.iloc[:, i].to_numpy() if frame else table[:, i]

    return Columns(
        values=(table.iloc[:, kept] if frame else table[:, kept]) if len(kept) < n_columns else table,
        names=tuple(str(named[i]) for i in kept) if named is not None and all(isinstance(c, str) for c in named) else None,
        episodes=None if episode_at is None else whole_or_text(column(episode_at)),
        time=None if time_at is None else _finite_time(column(time_at)),
        index=_whole_index(X.index) if frame else None,
    )


def is_whole(value: Any) -> bool:
    """Whether a value is of an integer type; truth values are not."""
    return isinstance(value, (int, np.integer)) and not isinstance(value, bool)


def _table(X: Any) -> Objects:
    table = np.asarray(X)
    if table.ndim != 2:
        raise DataError(f"Expected 2D array, got {table.ndim}D array of shape {table.shape}: one row a sample. Reshape your data.")
    if table.dtype.kind in "US":
        raise DataError("An array of text holds no numbers; pass a DataFrame, or an array of dtype object, where only the episode is text.")
    return table


def _episode_position(named: list[Any] | None, episode_feature: bool) -> int | None:
    if named is not None and named.count(EPISODE) > 1:
        raise DataError(f"The frame has {named.count(EPISODE)} columns named {EPISODE!r}; keep one.")
    if named is not None and EPISODE in named:
        return named.index(EPISODE)
    return 0 if episode_feature else None


def _time_position(time: str | int, named: list[Any] | None, n_columns: int) -> int:
    if named is not None and time in named:
        return named.index(time)
    if named is None and is_whole(time) and 0 <= int(time) < n_columns:
        return int(time)
    found = f"columns {named}" if named is not None else f"{n_columns} columns without names"
    raise DataError(f"Asked for the time in column {time!r}, found {found}; correct the parameter `time`.")


def _whole_index(index: Any) -> Array | None:
    values = np.asarray(index)
    return values.astype(float) if values.dtype.kind in "iu" else None


def _finite_time(values: Objects) -> Array:
    try:
        time = np.asarray(values, dtype=float)
    except (TypeError, ValueError) as error:
        raise DataError(f"The column of time should hold numbers, in seconds ({error}); convert it.") from error
    bad = np.flatnonzero(~np.isfinite(time))
    if bad.size:
        raise DataError(f"The column of time holds {time[bad[0]]} in row {bad[0]}; remove the row, or record the time.")
    return time


def whole_or_text(ids: npt.ArrayLike) -> Objects:
    """Return episode ids that can be told apart: int64, or objects that are all whole numbers or all text.

    Raises
    ------
    DataError
        Ids that are missing, fractions, truth values, of mixed kinds, or floats so large (2**53 and more
        for float64) that rounding may have merged them.
    """
    values = np.asarray(ids)
    if values.dtype.kind in "iu":
        return values
    if values.dtype.kind == "f":
        _check_float_ids(values)
        return values.astype(np.int64)
    found = np.array([_one_id(value, row) for row, value in enumerate(values.tolist())], dtype=object)
    if len({isinstance(value, str) for value in found}) > 1:
        number = next(value for value in found if not isinstance(value, str))
        text = next(value for value in found if isinstance(value, str))
        raise DataError(f"Episode ids mix text ({text!r}) and numbers ({number!r}); convert the column to one of them.")
    return found


def _check_float_ids(values: npt.NDArray[np.floating[Any]]) -> None:
    bad = np.flatnonzero(~(np.isfinite(values) & (values == np.round(values))))
    if bad.size:
        raise DataError(
            f"Episode ids should be whole numbers or text, found {values[bad[0]]} in row {bad[0]} (NaN and inf are no ids either); "
            "correct the column, or set episode_feature = False where the first column is no episode."
        )
    bits = min(_BITS, np.finfo(values.dtype).nmant + 1)
    large = np.flatnonzero(np.abs(values) >= 2**bits)
    if large.size:
        raise DataError(
            f"Episode id {values[large[0]]:.17g} in row {large[0]} is a {values.dtype} beyond 2**{bits}, where neighbouring ids become "
            "one; pass a DataFrame whose column of episodes is int64 or text."
        )


def _one_id(value: Any, row: int) -> int | str:
    if isinstance(value, str):
        return value
    if is_whole(value):
        return int(value)
    if isinstance(value, (float, np.floating)):
        _check_float_ids(np.array([value]))
        return int(value)
    raise DataError(f"Episode ids should be whole numbers or text, found {value!r} in row {row}; fill in or remove that row.")


def finite(values: Array, names: Sequence[str], what: str) -> Array:
    """Return the values, or say where they are not finite.

    Raises
    ------
    DataError
    """
    good = np.isfinite(values)
    if not good.all():
        row, column = (int(i) for i in np.argwhere(~good)[0])
        count = int(np.count_nonzero(~good))
        raise DataError(
            f"{what} contains NaN or inf: {values[row, column]} in row {row}, column {names[column]!r} ({count} values in all); "
            "remove the episode, or repair the recording."
        )
    return values


def episode_edges(columns: Columns, groups: npt.ArrayLike | None, n_samples: int) -> npt.NDArray[np.int64]:
    """Find where episodes begin and end.

    Parameters
    ----------
    columns : Columns
    groups : array_like, shape (n_samples,), optional
        Ids of units: rows of two units are never one episode.
    n_samples : int

    Returns
    -------
    ndarray, shape (n_episodes + 1,)
        First row of every episode, and the number of rows.

    Raises
    ------
    DataError
        The rows of an episode are not together, too few, or not in even steps of time.
    """
    ids = [] if columns.episodes is None else [columns.episodes]
    if groups is not None:
        units = whole_or_text(groups)
        if len(units) != n_samples:
            raise DataError(
                f"groups should name a unit for each of the {n_samples} rows, found {len(units)}; pass the groups of these rows."
            )
        ids.append(units)
    changes = [np.flatnonzero(column[1:] != column[:-1]) + 1 for column in ids]
    edges = np.unique(np.concatenate([[0], *changes, [n_samples]])).astype(np.int64)
    _check_together(ids, edges)
    short = np.flatnonzero(np.diff(edges) < 2)
    if short.size:
        k = int(short[0])
        raise DataError(
            f"{_title(ids, edges[k])}: found n_samples = {edges[k + 1] - edges[k]} (1 sample, row {edges[k]}), a transition needs at least 2; "
            "leave the episode out."
        )
    _check_steps(columns.time, ids, edges, "time")
    _check_steps(columns.index, ids, edges, "index")
    return edges


def _title(ids: list[Objects], row: int) -> str:
    return f"Episode {', unit '.join(str(column[row]) for column in ids)}" if ids else "The only episode"


def _check_together(ids: list[Objects], edges: npt.NDArray[np.int64]) -> None:
    seen: dict[tuple[Any, ...], tuple[int, int]] = {}
    for start, stop in pairwise(edges.tolist()):
        key = tuple(column[start] for column in ids)
        if key in seen:
            first, last = seen[key]
            raise DataError(
                f"{_title(ids, start)} stands in rows {first} to {last} and again in rows {start} to {stop - 1}; keep the rows of an "
                "episode together and in order of time (sort a frame by episode and time), or give its parts ids of their own."
            )
        seen[key] = (start, stop - 1)


def _check_steps(steps_of: Array | None, ids: list[Objects], edges: npt.NDArray[np.int64], what: str) -> None:
    """Refuse time (or a frame's index) that does not advance in equal steps within an episode."""
    if steps_of is None:
        return
    steps = np.diff(steps_of)
    inside = np.ones(len(steps), dtype=bool)
    inside[edges[1:-1] - 1] = False
    if not inside.any():
        return
    usual = float(np.median(steps[inside]))
    wrong = inside & (~(steps > 0) | (np.abs(steps - usual) > _STEP_TOLERANCE * usual))
    if wrong.any():
        k = int(np.flatnonzero(wrong)[0])
        episode = int(np.searchsorted(edges, k, side="right")) - 1
        raise DataError(
            f"{_title(ids, edges[episode])}: {what} goes from {steps_of[k]:.10g} to {steps_of[k + 1]:.10g} between rows {k} and {k + 1}, "
            f"where the usual step is {usual:g}; sort the rows by time, resample them, or give the parts of an interrupted recording ids "
            "of their own (cross-validation should keep episodes whole: use GroupKFold, or pairs of rows)."
        )


def log_forgotten_episodes(values: Array, name: str) -> None:
    """Warn where the first state looks like a column of episodes that was not declared."""
    first = values[:, 0]
    changes = np.count_nonzero(np.diff(first))
    if len(first) > 2 and changes < len(first) // 2 and np.all(first == np.round(first)) and len(np.unique(first)) == changes + 1 > 1:
        log.warning("column %r looks like an episode id but is taken as a state; set episode_feature=True if it is one", name)


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

    Examples
    --------
    >>> from kros.interop import one_step_pairs
    >>> X = [[0, 1.0, 0.1], [0, 2.0, 0.2], [1, 5.0, 0.3], [1, 6.0, 0.4]]  # episode, state, input
    >>> now, after, episode = one_step_pairs(X, n_inputs=1, episode_feature=True)
    >>> now.tolist(), after.ravel().tolist(), episode.tolist()
    ([[1.0, 0.1], [5.0, 0.3]], [2.0, 6.0], [0, 1])
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
