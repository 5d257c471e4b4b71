"""A long pandas DataFrame: one row a sample, with columns that name unit, condition and episode."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from itertools import groupby
from typing import Any

import numpy as np
import numpy.typing as npt

from ...core.errors import DataError, MissingDependencyError
from ..population import DEFAULT_CONDITION, Channel, EpisodeKey, Population, Unit, columns_in_order
from ..prepare import assemble
from .arrays import ArrayRecordings, as_numbers, declare_channels


def from_frame(
    frame: Any,
    channels: Sequence[Channel] | None = None,
    *,
    states: Sequence[str] = (),
    inputs: Sequence[str] = (),
    measured: Sequence[str] = (),
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
    channels : sequence of Channel, optional
        In place of `states`, `inputs` and `measured`, with units of measure.
    states, inputs : sequence of str
        Names of columns.
    measured : sequence of str
        The states that a running observer will be given.
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

    Examples
    --------
    >>> import numpy as np
    >>> import pandas as pd
    >>> import kros
    >>> frame = pd.DataFrame({"unit": ["a"] * 50 + ["b"] * 50, "angle": np.arange(100) / 10, "torque": np.cos(np.arange(100))})
    >>> kros.from_frame(frame, states=["angle"], inputs=["torque"], measured=["angle"], sample_period_s=0.01)
    Population(2 units, 1 condition, 2 episodes every 0.01 s; states angle (measured); inputs torque)
    """
    _require_frame(frame)
    if (time is None) == (sample_period_s is None):
        raise DataError(
            f"from_frame needs one of time and sample_period_s, found time = {time!r}, sample_period_s = {sample_period_s!r}."
        )
    ordered = columns_in_order(declare_channels(channels, states, inputs, measured, "from_frame"))
    required = [unit, *([] if time is None else [time]), *(c.name for c in ordered)]
    columns = list(frame.columns)
    missing = [name for name in required if name not in columns]
    if missing:
        raise DataError(
            f"from_frame: column {missing[0]!r} is missing, found {columns}; rename a column or correct the channels."
        )
    twice = [name for name in (*required, condition, episode) if name is not None and columns.count(name) > 1]
    if twice:
        raise DataError(
            f"from_frame: column {twice[0]!r} occurs {columns.count(twice[0])} times in {columns}; rename or drop the others."
        )
    ids = zip(_ids(frame, unit, ""), _ids(frame, condition, DEFAULT_CONDITION), _ids(frame, episode, "0"), strict=True)
    numbers = _numbers(frame, [c.name for c in ordered])
    times = None if time is None else _numbers(frame, [time])[:, 0]
    found: dict[EpisodeKey, tuple[npt.NDArray[np.float64], npt.NDArray[np.float64] | None]] = {}
    start = 0
    for names, run in groupby(ids):
        key, rows = EpisodeKey(*names), slice(start, start := start + sum(1 for _ in run))
        if key in found:
            raise DataError(
                f"from_frame: the rows of {key} are not together; sort the frame by unit, condition, episode and time, "
                "or rename the copies."
            )
        found[key] = numbers[rows], None if times is None else times[rows]
    return assemble(ArrayRecordings(found), ordered, units, sample_period_s, metadata)


def _require_frame(frame: Any) -> None:
    try:
        import pandas as pd
    except ImportError as error:
        raise MissingDependencyError(
            "from_frame needs pandas, which is not installed; install it (pip install pandas), or use from_arrays."
        ) from error
    if not isinstance(frame, pd.DataFrame):
        raise DataError(
            f"from_frame needs a pandas DataFrame, found {type(frame).__name__}; use from_arrays for arrays."
        )


def _ids(frame: Any, column: str | None, default: str) -> list[str]:
    if column is None or column not in frame.columns:
        return [default] * len(frame)
    values = frame[column].to_numpy(dtype=object)
    bad = next((v for v in values if isinstance(v, bool) or not isinstance(v, (str, int, np.integer))), None)
    if bad is not None:
        raise DataError(
            f"from_frame: column {column!r} should hold text or whole numbers, found {bad!r}; convert it with "
            "astype(str), keeping leading zeros."
        )
    return [str(v) for v in values]


def _numbers(frame: Any, names: list[str]) -> npt.NDArray[np.float64]:
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
