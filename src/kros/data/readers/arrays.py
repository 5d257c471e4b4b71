"""Recordings that are in memory already: arrays, or a long pandas DataFrame."""

from collections.abc import Iterable, Iterator, Mapping, Sequence
from typing import Any

import numpy as np

from ...core import Array, ByName, DataError, did_you_mean, frozen, grouped, shortened
from ...core.arrays import as_numbers
from ..population import DEFAULT_CONDITION, Channel, Channels, EpisodeKey, Population, Role, Unit, columns_in_order
from ..prepare import assemble
from ..recording import Recording, Recordings, check_period, check_structure, title


@frozen
class ArrayRecordings(Recordings):
    """Episodes held in memory, with their times or None, columns in the order of the channels; made read-only."""

    def __post_init__(self) -> None:
        for values, _ in self.places.values():
            values.flags.writeable = False

    def read(self, key: EpisodeKey) -> Recording:
        """Return one episode."""
        return Recording(key, *self.places[key])


def declare_channels(
    channels: Sequence[Channel] | None, states: Sequence[str], inputs: Sequence[str], measured: Sequence[str], what: str
) -> Channels:
    """Return the channels as given, or those that the names declare."""
    if (channels is None) != bool(states):
        raise DataError(f"{what}: give the names of states, inputs and measured, or channels, found {list(states)}.")
    if channels is not None:
        return tuple(channels)
    for name, value in {"states": states, "inputs": inputs, "measured": measured}.items():
        if isinstance(value, str):
            raise DataError(f"{what}: {name} should be a list of names, found the text {value!r}; write [{value!r}].")
    if not measured or not set(measured) <= set(states):
        raise DataError(f"{what}: measured should name some of the states {list(states)}, found {list(measured)}.")
    recorded = (Channel(s, Role.STATE, measured=s in measured) for s in states)
    return (*recorded, *(Channel(u, Role.INPUT) for u in inputs))


def from_arrays(
    data: Any,
    channels: Sequence[Channel] | None = None,
    sample_period_s: float | None = None,
    *,
    states: Sequence[str] = (),
    inputs: Sequence[str] = (),
    measured: Sequence[str] = (),
    units: Iterable[Unit] = (),
    metadata: ByName | None = None,
) -> Population:
    """Make a population from arrays.

    Parameters
    ----------
    data : mapping
        One of: ``{unit: [episode, ...]}``; ``{unit: {condition: [episode, ...]}}``; ``{EpisodeKey: episode}``. An
        episode is an array of shape (n_samples, n_channels) with states, then inputs, as columns; a pair (states,
        inputs); or a mapping from the name of a channel to its samples, shape (n_samples,).
    channels : sequence of Channel, optional
        In place of `states`, `inputs` and `measured`, with units of measure, in the order of the columns.
    sample_period_s : float, s
    states, inputs : sequence of str
        Names of the columns.
    measured : sequence of str
        The states that a running observer will be given.
    units : iterable of Unit
        Groups, where known.
    metadata : mapping, optional
        Facts about the batch.

    Returns
    -------
    Population

    Raises
    ------
    DataError
        Arrays that are not two-dimensional numbers or do not have one column per channel; names that clash.

    Examples
    --------
    >>> import numpy as np
    >>> from kros.data import from_arrays
    >>> angle, rate, torque = np.random.default_rng(1).standard_normal((3, 500))
    >>> episode = {"angle": angle, "rate": rate, "torque": torque}
    >>> names = {"states": ["angle", "rate"], "inputs": ["torque"], "measured": ["angle"]}
    >>> from_arrays({"a": [episode]}, sample_period_s=0.01, **names)
    <Population: units 1, episodes 1, conditions default, period 0.01 s, states angle (1, measured), rate (1), ...>
    """
    check_period(sample_period_s, "from_arrays")
    declared = declare_channels(channels, states, inputs, measured, "from_arrays")
    columns = columns_in_order(declared)
    order = [declared.index(c) for c in columns]
    episodes = list(_episodes(data))
    check_structure(columns, [key for key, _ in episodes])  # 1 and "1" are one unit
    places = {key: (np.ascontiguousarray(_samples(key, one, declared)[:, order]), None) for key, one in episodes}
    return assemble(ArrayRecordings(places), columns, units, sample_period_s, metadata)


def _episodes(data: Any) -> Iterator[tuple[EpisodeKey, Any]]:
    """Yield every episode of a mapping from units, from units and conditions, or from keys."""
    if not isinstance(data, Mapping):
        raise DataError(f"from_arrays needs a mapping from units to episodes, found {shortened(repr(data))}.")
    for unit, of_unit in data.items():
        if isinstance(unit, EpisodeKey):
            yield unit, of_unit
            continue
        conditions = of_unit if isinstance(of_unit, Mapping) else {DEFAULT_CONDITION: of_unit}
        for condition, episodes in conditions.items():
            if isinstance(episodes, str | bytes | Mapping) or not isinstance(episodes, Iterable):
                needs = f"unit {unit} ({condition}) needs a list of episodes"
                raise DataError(f"from_arrays: {needs}, found {shortened(repr(episodes))}; correct it.")
            yield from ((EpisodeKey(str(unit), str(condition), str(i)), one) for i, one in enumerate(episodes))


def _samples(key: EpisodeKey, episode: Any, channels: Sequence[Channel]) -> Array:
    """Return the samples of an episode, shape (n_samples, n_channels), columns as declared."""
    if isinstance(episode, Mapping):
        missing = next((c.name for c in channels if c.name not in episode), None)
        if missing is not None:
            raise DataError(f"{title(key)}: channel {missing!r} is missing, found {list(episode)}; correct the names.")
        episode = tuple(episode[c.name] for c in channels)
    try:
        whole = not isinstance(episode, tuple)
        values = as_numbers(episode) if whole else np.column_stack([as_numbers(part) for part in episode])
    except (ValueError, TypeError, OverflowError, RecursionError) as error:
        raise DataError(f"{title(key)}: needs numbers, found something else ({error}); correct it.") from error
    if values.ndim != 2 or values.shape[1] != len(channels):
        raise DataError(f"{title(key)}: needs shape (n_samples, {len(channels)}), found {values.shape}; transpose it.")
    return values


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
) -> Population:
    """Make a population from a long pandas DataFrame, one row a sample.

    Parameters
    ----------
    frame : pandas.DataFrame
        Rows of an episode in order of time.
    channels, states, inputs, measured
        As in `from_arrays`.
    time : str, optional
        Column of time, s; or give `sample_period_s`.
    sample_period_s : float, optional
    unit, condition, episode : str
        Columns of text or whole numbers; `condition` and `episode` get a default where None or absent.

    Returns
    -------
    Population

    Raises
    ------
    DataError
        A missing column, ids that are not text or whole numbers; when episodes are read, time that is not even.

    Examples
    --------
    >>> import numpy as np
    >>> import pandas as pd
    >>> import kros
    >>> frame = pd.DataFrame({"unit": ["a"] * 50 + ["b"] * 50, "x": np.arange(100) / 10, "u": np.cos(np.arange(100))})
    >>> kros.from_frame(frame, states=["x"], inputs=["u"], measured=["x"], sample_period_s=0.01)
    <Population: units 2, episodes 2, conditions default, period 0.01 s, states x (1, measured), inputs u (1)>
    """
    if type(frame).__module__.partition(".")[0] != "pandas" or not hasattr(frame, "columns"):
        raise DataError(f"from_frame needs a pandas DataFrame, found {type(frame).__name__}; use from_arrays.")
    if (time is None) == (sample_period_s is None):
        raise DataError(f"from_frame needs one of time and sample_period_s, found {time!r} and {sample_period_s!r}.")
    ordered, known = columns_in_order(declare_channels(channels, states, inputs, measured, "from_frame")), list(frame)
    for name in filter(None, (*(c.name for c in ordered), time, unit)):
        if (count := known.count(name)) != 1:
            problem = f"occurs {count} times;" if count else f"is missing{did_you_mean(name, known)}"
            raise DataError(f"from_frame: column {name!r} {problem} the columns are {known}; correct the name.")
    numbers = np.column_stack([_column(frame, c.name) for c in ordered])
    times = None if time is None else _column(frame, time)
    ids = _ids(frame, unit, None), _ids(frame, condition, DEFAULT_CONDITION), _ids(frame, episode, "0")
    keys = list(map(EpisodeKey, *ids))
    rows = grouped(range(len(keys)), keys.__getitem__)  # they need not stand together
    places = {key: (numbers[at], None if times is None else times[at]) for key, at in rows.items()}
    return assemble(ArrayRecordings(places), ordered, sample_period_s=sample_period_s)


def _ids(frame: Any, column: str | None, default: str | None) -> list[str]:
    """Return the names of a column, row by row."""
    if default is not None and column not in frame.columns:
        return [default] * len(frame)
    values = frame[column].to_numpy(dtype=object)
    bad = next((v for v in values if isinstance(v, bool) or not isinstance(v, (str, int, np.integer))), None)
    if bad is not None:
        raise DataError(f"from_frame: column {column!r} should hold text or whole numbers, found {bad!r}; convert it.")
    return [str(v) for v in values]


def _column(frame: Any, name: str) -> Array:
    """Return a column of numbers."""
    column = frame[name]
    try:
        missing = {"dtype": float, "na_value": np.nan} if column.dtype.kind in "biuf" else {}
        return as_numbers(column.to_numpy(**missing))
    except (TypeError, ValueError, OverflowError) as error:
        raise DataError(f"from_frame: column {name!r} should hold numbers ({error}); convert it.") from error
