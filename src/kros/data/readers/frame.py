"""A long pandas DataFrame: one row a sample, with columns that name unit, condition and episode."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from itertools import pairwise
from typing import Any

import numpy as np
import numpy.typing as npt

from ...core.errors import DataError, MissingDependencyError
from ..population import DEFAULT_CONDITION, Channel, EpisodeKey, Population, Role, Unit
from ..prepare import Recorded, assemble
from .arrays import ArrayRecordings, as_numbers


def from_frame(
    frame: Any,
    channels: Sequence[Channel],
    *,
    time: str | None = None,
    sample_period_s: float | None = None,
    unit: str = "unit",
    condition: str | None = "condition",
    episode: str | None = "episode",
    units: Iterable[Unit] = (),
    metadata: Mapping[str, Any] | None = None,
) -> Population:
    """Make a population from a long DataFrame.

    Parameters
    ----------
    frame : pandas.DataFrame
        Rows of an episode in order of time.
    channels : sequence of Channel
        Their names are columns; states are moved before inputs.
    time : str, optional
        Column of time, s; or give `sample_period_s`.
    sample_period_s : float, optional
    unit, condition, episode : str
        Columns of text or whole numbers; `condition` and `episode` get a default where None or absent.
    units : iterable of Unit
        Group and metadata, where known.
    metadata : mapping, optional

    Returns
    -------
    Population

    Raises
    ------
    DataError
        A missing column, ids that are not text or whole numbers, uneven time.
    MissingDependencyError
        Without pandas.
    """
    _require_frame(frame)
    if (time is None) == (sample_period_s is None):
        raise DataError(f"from_frame needs one of time and sample_period_s, found time = {time!r}, sample_period_s = {sample_period_s!r}.")
    ordered = tuple(sorted(channels, key=lambda c: c.role is Role.INPUT))
    required = [unit, *([] if time is None else [time]), *(c.name for c in ordered)]
    columns = list(frame.columns)
    missing = [name for name in required if name not in columns]
    if missing:
        raise DataError(
            f"from_frame: column {missing[0]!r} is missing, found {list(frame.columns)}; rename a column or correct the channels."
        )
    twice = [name for name in (*required, condition, episode) if name is not None and columns.count(name) > 1]
    if twice:
        raise DataError(f"from_frame: column {twice[0]!r} occurs {columns.count(twice[0])} times in {columns}; rename or drop the others.")
    n = len(frame)
    ids = (
        np.column_stack([_ids(frame, unit, ""), _ids(frame, condition, DEFAULT_CONDITION), _ids(frame, episode, "0")])
        if n
        else np.empty((0, 3), object)
    )
    numbers = _numbers(frame, [c.name for c in ordered])
    times = None if time is None else _numbers(frame, [time])[:, 0]
    rows: dict[EpisodeKey, slice] = {}
    for key, at in _runs(ids):
        if key in rows:
            raise DataError(
                f"from_frame: the rows of {key} are not together; sort the frame by unit, condition, episode and time, "
                "or rename the copies."
            )
        rows[key] = at
    recordings = ArrayRecordings(
        {k: numbers[at] for k, at in rows.items()}, None if times is None else {k: times[at] for k, at in rows.items()}
    )
    facts = {u.id: u for u in units}
    found = [facts.get(name, Unit(name)) for name in dict.fromkeys(key.unit for key in rows)]
    return assemble(Recorded(ordered, found, list(rows), recordings, sample_period_s, dict(metadata or {})))


def _require_frame(frame: Any) -> None:
    try:
        import pandas as pd
    except ImportError as error:
        raise MissingDependencyError(
            "from_frame needs pandas, which is not installed; install it (pip install pandas), or use from_arrays."
        ) from error
    if not isinstance(frame, pd.DataFrame):
        raise DataError(f"from_frame needs a pandas DataFrame, found {type(frame).__name__}; use from_arrays for arrays.")


def _ids(frame: Any, column: str | None, default: str) -> npt.NDArray[np.object_]:
    if column is None or column not in frame.columns:
        return np.full(len(frame), default, dtype=object)
    values = frame[column].to_numpy(dtype=object)
    bad = next((v for v in values if isinstance(v, bool) or not isinstance(v, (str, int, np.integer))), None)
    if bad is not None:
        raise DataError(
            f"from_frame: column {column!r} should hold text or whole numbers, found {bad!r}; convert it with "
            "astype(str), keeping leading zeros."
        )
    return np.array([str(v) for v in values], dtype=object)


def _numbers(frame: Any, names: list[str]) -> npt.NDArray[np.float64]:
    if not names:
        return np.empty((len(frame), 0))
    return np.column_stack([_column(frame[name], name) for name in names])


def _column(column: Any, name: str) -> npt.NDArray[np.float64]:
    try:
        if column.dtype.kind in "OMmSU":
            return as_numbers(column.to_numpy())
        if column.dtype.kind not in "biuf":
            raise TypeError(f"{column.dtype} cannot be used as real numbers")
        return np.asarray(column.to_numpy(dtype=float, na_value=np.nan))
    except (TypeError, ValueError, OverflowError) as error:
        raise DataError(f"from_frame: column {name!r} should hold numbers ({error}); convert it.") from error


def _runs(ids: npt.NDArray[np.object_]) -> Iterator[tuple[EpisodeKey, slice]]:
    """Yield each run of equal ids with its rows."""
    if not len(ids):
        return
    starts = np.concatenate([[0], np.flatnonzero(np.any(ids[1:] != ids[:-1], axis=1)) + 1, [len(ids)]])
    for start, stop in pairwise(starts.tolist()):
        yield EpisodeKey(*ids[start]), slice(start, stop)
