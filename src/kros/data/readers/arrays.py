"""Recordings that are in memory already: arrays by unit, condition and episode."""

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


@dataclass(frozen=True, eq=False)
class ArrayRecordings(Recordings):
    """Episodes held in memory, with their times or None, columns in the order of the channels; the arrays are made read-only."""

    def __post_init__(self) -> None:
        """Protect the samples, which every reader of the population shares."""
        for values, _ in self.places.values():
            values.flags.writeable = False

    def read(self, key: EpisodeKey, place: tuple[npt.NDArray[np.float64], npt.NDArray[np.float64] | None]) -> Recording:
        """Return one episode."""
        return Recording(key, *place)


def declare_channels(
    channels: Sequence[Channel] | None, states: Sequence[str], inputs: Sequence[str], measured: Sequence[str], what: str
) -> tuple[Channel, ...]:
    """Return the channels as given, or those that the names declare."""
    if (channels is None) != bool(states):
        raise DataError(
            f"{what}: give the names of states, inputs and measured, or channels, found states = {list(states)} and channels = {channels!r}."
        )
    if channels is not None:
        return tuple(channels)
    for name, value in {"states": states, "inputs": inputs, "measured": measured}.items():
        if isinstance(value, str):
            raise DataError(f"{what}: {name} should be a list of names, found the text {value!r}; write [{value!r}].")
    unknown = [name for name in measured if name not in states]
    if unknown or not measured:
        raise DataError(
            f"{what}: measured should name the states that a running observer will be given, found {list(measured)} for the states "
            f"{list(states)}; name one of them at least."
        )
    return (
        *(Channel(s, Role.STATE, measured=s in measured) for s in states),
        *(Channel(u, Role.INPUT) for u in inputs),
    )


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
        One of: ``{unit: [episode, ...]}``; ``{unit: {condition: [episode, ...]}}``; the same with a mapping from episode id in place of a list;
        ``{EpisodeKey: episode}``; or a list in place of the outer mapping, which numbers the units from zero. An episode is an array of shape
        (n_samples, n_channels) with states, then inputs, as columns; a pair (states, inputs); or a mapping from the name of a channel to its
        samples, shape (n_samples,).
    channels : sequence of Channel, optional
        In place of `states`, `inputs` and `measured`, with units of measure, in the order of the columns; states are moved before inputs, truths behind
        both.
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
    >>> from_arrays({"a": [episode]}, states=["angle", "rate"], inputs=["torque"], measured=["angle"], sample_period_s=0.01)
    Population(1 unit, 1 condition, 1 episode every 0.01 s; states angle (measured), rate; inputs torque)
    """
    check_period(sample_period_s, "from_arrays")
    declared = declare_channels(channels, states, inputs, measured, "from_arrays")
    columns = columns_in_order(declared)
    order = [declared.index(c) for c in columns]
    found = {
        key: (np.ascontiguousarray(_samples(key, e, declared)[:, order]), None)
        for key, e in _episodes(data, {c.name for c in declared})
    }
    return assemble(ArrayRecordings(found), columns, units, sample_period_s, metadata)


def as_numbers(values: Any) -> npt.NDArray[np.float64]:
    """Return an array of doubles; text, complex numbers and dates are refused rather than converted."""
    found = np.asarray(values)
    kind = found.dtype.kind
    if kind not in "biufO" or (
        kind == "O" and any(isinstance(v, (str, bytes, complex)) for v in found.ravel().tolist())
    ):
        raise TypeError(f"{'text or complex numbers' if kind == 'O' else found.dtype} cannot be used as real numbers")
    return np.asarray(found, dtype=float)


def _named(items: Any) -> Iterator[tuple[Any, Any]]:
    if isinstance(items, Mapping):
        yield from items.items()
    elif isinstance(items, Iterable) and not isinstance(items, str | bytes) and getattr(items, "shape", True):
        yield from ((str(i), item) for i, item in enumerate(items))
    else:
        raise DataError(
            f"from_arrays needs mappings or lists of episodes, found {shortened(repr(items))}; see its documentation."
        )


def _episodes(data: Any, channels: set[str]) -> Iterator[tuple[EpisodeKey, Any]]:
    """Yield every episode; a mapping is an episode where it names a channel."""

    def holds_episodes(item: Any) -> bool:
        return isinstance(item, list) or (isinstance(item, Mapping) and not channels & set(item))

    for unit, of_unit in _named(data):
        if isinstance(unit, EpisodeKey):
            yield unit, of_unit
        elif isinstance(of_unit, Mapping) and any(holds_episodes(v) for v in of_unit.values()):
            for condition, episodes in of_unit.items():
                yield from (
                    (EpisodeKey(str(unit), str(condition), str(name)), episode) for name, episode in _named(episodes)
                )
        else:
            yield from (
                (EpisodeKey(str(unit), DEFAULT_CONDITION, str(name)), episode) for name, episode in _named(of_unit)
            )


def _samples(key: EpisodeKey, episode: Any, channels: Sequence[Channel]) -> npt.NDArray[np.float64]:
    names = [c.name for c in channels]
    if isinstance(episode, Mapping):
        missing = [name for name in names if name not in episode]
        if missing:
            raise DataError(
                f"{title(key)}: channel {missing[0]!r} is missing, found {list(episode)}; add it, or correct the names."
            )
        episode = tuple(episode[name] for name in names)
    try:
        parts = [as_numbers(part) for part in (episode if isinstance(episode, tuple) else (episode,))]
        values = parts[0] if len(parts) == 1 and not isinstance(episode, tuple) else np.column_stack(parts)
    except (ValueError, TypeError, OverflowError, RecursionError) as error:
        raise DataError(
            f"{title(key)}: needs numbers of shape (n_samples, {len(channels)}), found something else ({error}); correct the array."
        ) from error
    if values.ndim != 2 or values.shape[1] != len(channels):
        raise DataError(
            f"{title(key)}: needs shape (n_samples, {len(channels)}) for the channels {names}, found {values.shape}; transpose or correct "
            "the array."
        )
    return values
