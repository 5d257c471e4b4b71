"""Recordings that are in memory already: arrays, a long pandas DataFrame, pykoop's single array."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from ...core.errors import DataError
from ...core.files import shortened
from ..checks import check_period
from ..population import DEFAULT_CONDITION, Channel, EpisodeKey, Population, Role, Unit, columns_in_order
from ..prepare import assemble
from ..recording import Recording, Recordings, title

Array = npt.NDArray[np.float64]
_EXACT = 2.0**53  # floating-point numbers from here on do not tell whole numbers apart


@dataclass(frozen=True, eq=False)
class ArrayRecordings(Recordings):
    """Episodes held in memory, with their times or None, columns in the order of the channels; made read-only."""

    def __post_init__(self) -> None:
        for values, _ in self.places.values():
            values.flags.writeable = False

    def read(self, key: EpisodeKey, place: tuple[Array, Array | None]) -> Recording:
        """Return one episode."""
        return Recording(key, *place)


def declare_channels(
    channels: Sequence[Channel] | None, states: Sequence[str], inputs: Sequence[str], measured: Sequence[str], what: str
) -> tuple[Channel, ...]:
    """Return the channels as given, or those that the names declare."""
    if (channels is None) != bool(states):
        actual = f"found states = {list(states)} and channels = {channels!r}"
        raise DataError(f"{what}: give the names of states, inputs and measured, or channels, {actual}.")
    if channels is not None:
        return tuple(channels)
    for name, value in {"states": states, "inputs": inputs, "measured": measured}.items():
        if isinstance(value, str):
            raise DataError(f"{what}: {name} should be a list of names, found the text {value!r}; write [{value!r}].")
    if not measured or not set(measured) <= set(states):
        wanted = "measured should name the states that a running observer will be given"
        actual = f"found {list(measured)} for the states {list(states)}"
        raise DataError(f"{what}: {wanted}, {actual}; name one of them at least.")
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
    metadata: Mapping[str, Any] | None = None,
) -> Population:
    """Make a population from arrays.

    Parameters
    ----------
    data : mapping or sequence
        One of: ``{unit: [episode, ...]}``; ``{unit: {condition: [episode, ...]}}``; the same with a mapping from
        episode id in place of a list; ``{EpisodeKey: episode}``; or a list in place of the outer mapping, which
        numbers the units from zero. An episode is an array of shape (n_samples, n_channels) with states, then inputs,
        as columns; a pair (states, inputs); or a mapping from the name of a channel to its samples, shape
        (n_samples,).
    channels : sequence of Channel, optional
        In place of `states`, `inputs` and `measured`, with units of measure, in the order of the columns.
    sample_period_s : float, s
    states, inputs : sequence of str
        Names of the columns.
    measured : sequence of str
        The states that a running observer will be given.
    units : iterable of Unit
        Group and metadata, where known.
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
    Population(1 unit, 1 condition, 1 episode every 0.01 s; states angle (measured), rate; inputs torque)
    """
    check_period(sample_period_s, "from_arrays")
    declared = declare_channels(channels, states, inputs, measured, "from_arrays")
    columns = columns_in_order(declared)
    order = [declared.index(c) for c in columns]
    places = {
        key: (np.ascontiguousarray(_samples(key, episode, declared)[:, order]), None)
        for key, episode in _episodes(data, {c.name for c in declared})
    }
    return assemble(ArrayRecordings(places), columns, units, sample_period_s, metadata)


def as_numbers(values: Any) -> Array:
    """Return an array of doubles; text, complex numbers and dates are refused rather than converted."""
    array = np.asarray(values)
    kind = array.dtype.kind
    if kind == "O" and any(isinstance(v, (str, bytes, complex)) for v in array.ravel().tolist()):
        raise TypeError("text or complex numbers cannot be used as real numbers")
    if kind not in "biufO":
        raise TypeError(f"{array.dtype} cannot be used as real numbers")
    return np.asarray(array, dtype=float)


def _named(items: Any) -> Iterator[tuple[Any, Any]]:
    """Yield what a mapping or a list holds, with its key or number."""
    if isinstance(items, Mapping):
        yield from items.items()
    elif isinstance(items, Iterable) and not isinstance(items, str | bytes) and getattr(items, "shape", True):
        yield from ((str(i), item) for i, item in enumerate(items))
    else:
        needs = "from_arrays needs mappings or lists of episodes"
        raise DataError(f"{needs}, found {shortened(repr(items))}; see its documentation.")


def _episodes(data: Any, channels: set[str]) -> Iterator[tuple[EpisodeKey, Any]]:
    """Yield every episode; a mapping is an episode where it names a channel."""

    def holds_episodes(item: Any) -> bool:
        return isinstance(item, list) or (isinstance(item, Mapping) and not channels & set(item))

    for unit, of_unit in _named(data):
        if isinstance(unit, EpisodeKey):
            yield unit, of_unit
            continue
        conditions = of_unit if isinstance(of_unit, Mapping) and any(map(holds_episodes, of_unit.values())) else None
        for condition, episodes in (conditions or {DEFAULT_CONDITION: of_unit}).items():
            for name, episode in _named(episodes):
                yield EpisodeKey(str(unit), str(condition), str(name)), episode


def _samples(key: EpisodeKey, episode: Any, channels: Sequence[Channel]) -> Array:
    """Return the samples of an episode, shape (n_samples, n_channels), columns as declared."""
    names = [c.name for c in channels]
    if isinstance(episode, Mapping):
        missing = next((name for name in names if name not in episode), None)
        if missing is not None:
            actual = f"channel {missing!r} is missing, found {list(episode)}"
            raise DataError(f"{title(key)}: {actual}; add it, or correct the names.")
        episode = tuple(episode[name] for name in names)
    try:
        parts = [as_numbers(part) for part in episode] if isinstance(episode, tuple) else []
        values = np.column_stack(parts) if parts else as_numbers(episode)
    except (ValueError, TypeError, OverflowError, RecursionError) as error:
        needs = f"needs numbers of shape (n_samples, {len(channels)})"
        raise DataError(f"{title(key)}: {needs}, found something else ({error}); correct the array.") from error
    if values.ndim != 2 or values.shape[1] != len(channels):
        needs = f"needs shape (n_samples, {len(channels)}) for the channels {names}"
        raise DataError(f"{title(key)}: {needs}, found {values.shape}; transpose or correct the array.")
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
    units: Iterable[Unit] = (),
    metadata: Mapping[str, Any] | None = None,
) -> Population:
    """Make a population from a long pandas DataFrame, one row a sample.

    Parameters
    ----------
    frame : pandas.DataFrame
        Rows of an episode in order of time.
    channels, states, inputs, measured, units, metadata
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
        A missing column, ids that are not text or whole numbers, uneven time.

    Examples
    --------
    >>> import numpy as np
    >>> import pandas as pd
    >>> import kros
    >>> frame = pd.DataFrame({"unit": ["a"] * 50 + ["b"] * 50, "x": np.arange(100) / 10, "u": np.cos(np.arange(100))})
    >>> kros.from_frame(frame, states=["x"], inputs=["u"], measured=["x"], sample_period_s=0.01)
    Population(2 units, 1 condition, 2 episodes every 0.01 s; states x (measured); inputs u)
    """
    if type(frame).__module__.partition(".")[0] != "pandas" or not hasattr(frame, "columns"):
        raise DataError(
            f"from_frame needs a pandas DataFrame, found {type(frame).__name__}; use from_arrays for arrays."
        )
    if (time is None) == (sample_period_s is None):
        actual = f"found time = {time!r}, sample_period_s = {sample_period_s!r}"
        raise DataError(f"from_frame needs one of time and sample_period_s, {actual}.")
    ordered = columns_in_order(declare_channels(channels, states, inputs, measured, "from_frame"))
    _check_columns(frame, [unit, *([time] if time else []), *(c.name for c in ordered)], [condition, episode])
    defaults = ((unit, ""), (condition, DEFAULT_CONDITION), (episode, "0"))
    numbers = np.column_stack([_column(frame, c.name) for c in ordered])
    times = None if time is None else _column(frame, time)
    rows = _rows_of(map(EpisodeKey, *(_ids(frame, *named) for named in defaults)))
    places = {key: (numbers[at], None if times is None else times[at]) for key, at in rows.items()}
    return assemble(ArrayRecordings(places), ordered, units, sample_period_s, metadata)


def _check_columns(frame: Any, required: Sequence[str], optional: Sequence[str | None]) -> None:
    """Refuse a frame in which a column is missing or occurs twice."""
    columns = list(frame.columns)
    counts = {name: columns.count(name) for name in (*required, *optional) if name is not None}
    for name, count in counts.items():
        if count == 0 and name in required:
            advice = "rename a column or correct the channels"
            raise DataError(f"from_frame: column {name!r} is missing, found {columns}; {advice}.")
        if count > 1:
            raise DataError(
                f"from_frame: column {name!r} occurs {count} times in {columns}; rename or drop the others."
            )


def _ids(frame: Any, column: str | None, default: str) -> list[str]:
    """Return the names of a column, row by row."""
    if column is None or column not in frame.columns:
        return [default] * len(frame)
    values = frame[column].to_numpy(dtype=object)
    bad = next((v for v in values if not _is_name(v)), None)
    if bad is not None:
        wanted = f"column {column!r} should hold text or whole numbers, found {bad!r}"
        raise DataError(f"from_frame: {wanted}; convert it with astype(str), keeping leading zeros.")
    return [str(v) for v in values]


def _is_name(value: Any) -> bool:
    return isinstance(value, (str, int, np.integer)) and not isinstance(value, bool)


def _rows_of(keys: Iterable[EpisodeKey]) -> dict[EpisodeKey, list[int]]:
    """Return the rows of every episode, in their order; they need not stand together."""
    rows: dict[EpisodeKey, list[int]] = {}
    for row, key in enumerate(keys):
        rows.setdefault(key, []).append(row)
    return rows


def _column(frame: Any, name: str) -> Array:
    """Return a column of numbers."""
    column = frame[name]
    try:
        missing = {"dtype": float, "na_value": np.nan} if column.dtype.kind in "biuf" else {}
        return as_numbers(column.to_numpy(**missing))
    except (TypeError, ValueError, OverflowError) as error:
        raise DataError(f"from_frame: column {name!r} should hold numbers ({error}); convert it.") from error


def from_pykoop(
    X: npt.ArrayLike | Mapping[str, npt.ArrayLike],
    n_inputs: int,
    sample_period_s: float,
    *,
    channels: Sequence[Channel] | None = None,
) -> Population:
    """Make a population from pykoop's `X`; pykoop is not needed.

    Parameters
    ----------
    X : array_like, shape (n_samples, 1 + n_states + n_inputs), or mapping from unit id to such arrays
        First column the episode, then states, then inputs. One array is one unit, named ``0``. Episodes are whole
        numbers; in an array of objects they may be text. Rows of an episode need not stand together and keep their
        order.
    n_inputs : int
        How many of the last columns are inputs.
    sample_period_s : float
    channels : sequence of Channel, optional
        Default: states ``x0, x1, ...``, all measured, inputs ``u0, u1, ...``.

    Returns
    -------
    Population

    Raises
    ------
    DataError
        Wrong sizes, or episodes that are not whole numbers.

    Examples
    --------
    >>> from kros.data import from_pykoop
    >>> X = [[0, 1.0, 0.5], [0, 1.1, 0.5], [1, 2.0, 0.0], [1, 1.9, 0.0]]  # episode, state, input
    >>> from_pykoop({"a": X, "b": X}, n_inputs=1, sample_period_s=0.01)
    Population(2 units, 1 condition, 4 episodes every 0.01 s; states x0 (measured); inputs u0)
    """
    try:
        arrays = {str(u): np.asarray(x) for u, x in (X if isinstance(X, Mapping) else {"0": X}).items()}
    except (TypeError, ValueError, RecursionError) as error:
        needs = "needs an array (n_samples, n_columns) a unit"
        raise DataError(f"from_pykoop: {needs}, found something else ({error}); correct it.") from error
    if not arrays:
        raise DataError("from_pykoop: the mapping is empty; give one array per unit.")
    shapes = [x.shape for x in arrays.values()]
    whole = isinstance(n_inputs, (int, np.integer)) and not isinstance(n_inputs, bool)
    width = shapes[0][-1] if all(len(s) == 2 and s[-1] == shapes[0][-1] for s in shapes) else 0
    if not whole or not 0 <= n_inputs < width - 1:
        needs = f"needs arrays (n_samples, 1 + states + {n_inputs}) of one width"
        raise DataError(f"from_pykoop: {needs}, found {shapes[:5]}; check n_inputs.")
    states, inputs = [f"x{i}" for i in range(width - 1 - n_inputs)], [f"u{i}" for i in range(n_inputs)]
    named = channels if channels is not None else declare_channels(None, states, inputs, states, "from_pykoop")
    episodes: dict[EpisodeKey, Any] = {}
    for unit, x in arrays.items():
        rows = _rows_of(EpisodeKey(unit, DEFAULT_CONDITION, name) for name in _numbered_episodes(unit, x[:, 0]))
        episodes |= {key: x[at, 1:] for key, at in rows.items()}
    return from_arrays(episodes, named, sample_period_s)


def _numbered_episodes(unit: str, column: npt.NDArray[Any]) -> list[str]:
    """Return the names of the episodes, row by row; whole numbers are written without a point."""
    kind = column.dtype.kind
    if kind == "f":
        good = np.isfinite(column) & (column == np.round(column)) & (np.abs(column) < _EXACT)
    else:
        good = np.array([_is_name(v) for v in column], dtype=bool)
    if not good.all():
        row = int(np.argmin(good))
        wanted = "the first column should number the episodes (as floating-point numbers below 2**53)"
        actual = f"found {column.tolist()[row]!r} in row {row} of unit {unit}"
        raise DataError(f"from_pykoop: {wanted}, {actual}; use an integer or object array.")
    return [str(int(v) if kind == "f" else v) for v in column]


def to_pykoop(population: Population) -> Array:
    """Return a population as pykoop's `X`, with episodes numbered through in the order of ``population.episodes``.

    Parameters
    ----------
    population : Population

    Returns
    -------
    ndarray, shape (n_samples, 1 + n_states + n_inputs)
        Pass ``n_inputs=len(population.inputs), episode_feature=True`` to pykoop's `fit`.

    Examples
    --------
    >>> import numpy as np
    >>> import kros
    >>> arrays = {"a": [np.ones((3, 2)), np.zeros((3, 2))]}
    >>> population = kros.from_arrays(arrays, states=["x"], measured=["x"], inputs=["u"], sample_period_s=0.01)
    >>> kros.data.to_pykoop(population)[2:4].tolist()
    [[0.0, 1.0, 1.0], [1.0, 0.0, 0.0]]
    """
    parts = [population.read(key) for key in population.episodes]
    return np.concatenate([np.column_stack([np.full(len(part), float(i)), part]) for i, part in enumerate(parts)])
