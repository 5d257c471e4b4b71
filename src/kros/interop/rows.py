"""Rows of recordings as scikit-learn passes them: one array or frame, with or without a column of episodes.

    X ── split_columns ──► Columns (episode ids, values) ── episode_edges ──► where episodes begin

Nothing is sorted and no id passes through floating point on its way here, so two large ids never become one.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Any

import numpy as np
import numpy.typing as npt

from ..core.errors import DataError

Array = npt.NDArray[np.float64]
Objects = npt.NDArray[Any]

EPISODE = "episode"
_BITS = 53  # from 2**53 on neighbouring whole numbers share a float64


@dataclass(frozen=True, eq=False)
class Columns:
    """Rows split by what their columns mean: values not yet checked, their names, ids, and a frame's whole-number index."""

    values: Any
    names: tuple[str, ...] | None
    episodes: Objects | None = None
    index: Array | None = None


def split_columns(X: Any, *, episode_feature: bool) -> Columns:
    """Split rows into ids and values; a frame's column named ``episode`` is the episode wherever it stands, else the first column."""
    frame = hasattr(X, "iloc") and hasattr(X, "columns")
    named = list(X.columns) if frame else None
    table: Any = X if frame else _table(X)
    n_columns = table.shape[1]
    episode_at = _episode_position(named, episode_feature)
    kept = [i for i in range(n_columns) if i != episode_at]
    if not kept:
        raise DataError(f"Rows with {n_columns} columns hold no state beside the episode; add the columns of states and inputs.")

    def column(i: int) -> Objects:
        return table.iloc[:, i].to_numpy() if frame else table[:, i]

    return Columns(
        values=(table.iloc[:, kept] if frame else table[:, kept]) if len(kept) < n_columns else table,
        names=tuple(str(named[i]) for i in kept) if named is not None and all(isinstance(c, str) for c in named) else None,
        episodes=None if episode_at is None else whole_or_text(column(episode_at)),
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


def _whole_index(index: Any) -> Array | None:
    values = np.asarray(index)
    return values.astype(float) if values.dtype.kind in "iu" else None


def whole_or_text(ids: npt.ArrayLike) -> Objects:
    """Return episode ids that can be told apart, as int64 or objects; floats from 2**53 on may have merged by rounding and are refused."""
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
    """Return the values, or say where they are not finite."""
    good = np.isfinite(values)
    if not good.all():
        row, column = (int(i) for i in np.argwhere(~good)[0])
        count = int(np.count_nonzero(~good))
        raise DataError(
            f"{what} contains NaN or inf: {values[row, column]} in row {row}, column {names[column]!r} ({count} values in all); "
            "remove the episode, or repair the recording."
        )
    return values


def episode_edges(columns: Columns, n_samples: int) -> npt.NDArray[np.int64]:
    """Return the first row of every episode, and the number of rows."""
    ids = columns.episodes
    inner = np.empty(0, dtype=np.int64) if ids is None else np.flatnonzero(ids[1:] != ids[:-1]) + 1
    edges = np.concatenate([[0], inner, [n_samples]]).astype(np.int64)
    _check_together(ids, edges)
    short = np.flatnonzero(np.diff(edges) < 2)
    if short.size:
        k = int(short[0])
        raise DataError(
            f"{_title(ids, edges[k])}: found n_samples = {edges[k + 1] - edges[k]} (1 sample, row {edges[k]}), a transition needs at least 2; "
            "leave the episode out."
        )
    _check_index(columns.index, ids, edges)
    return edges


def _title(ids: Objects | None, row: int) -> str:
    return "The only episode" if ids is None else f"Episode {ids[row]}"


def _check_together(ids: Objects | None, edges: npt.NDArray[np.int64]) -> None:
    if ids is None:
        return
    seen: dict[Any, tuple[int, int]] = {}
    for start, stop in pairwise(edges.tolist()):
        key = ids[start]
        if key in seen:
            first, last = seen[key]
            raise DataError(
                f"{_title(ids, start)} stands in rows {first} to {last} and again in rows {start} to {stop - 1}; keep the rows of an "
                "episode together and in order of time (sort a frame by episode and time), or give its parts ids of their own."
            )
        seen[key] = (start, stop - 1)


def _check_index(index: Array | None, ids: Objects | None, edges: npt.NDArray[np.int64]) -> None:
    """Refuse a frame's index that does not advance in equal steps within an episode: rows were left out, or are not in order."""
    if index is None:
        return
    steps = np.diff(index)
    inside = np.ones(len(steps), dtype=bool)
    inside[edges[1:-1] - 1] = False
    if not inside.any():
        return
    usual = float(np.median(steps[inside]))
    wrong = inside & (~(steps > 0) | (steps != usual))
    if wrong.any():
        k = int(np.flatnonzero(wrong)[0])
        episode = int(np.searchsorted(edges, k, side="right")) - 1
        raise DataError(
            f"{_title(ids, edges[episode])}: index goes from {index[k]:.10g} to {index[k + 1]:.10g} between rows {k} and {k + 1}, "
            f"where the usual step is {usual:g}; keep the rows in order, or give the parts of an interrupted recording ids of their own "
            "(cross-validation should keep episodes whole: use GroupKFold)."
        )
