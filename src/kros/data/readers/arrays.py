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
from ..population import DEFAULT_CONDITION, Channel, EpisodeKey, Population, Role, Unit
from ..prepare import Recorded, assemble
from ..recording import Recording, look_up, title


@dataclass(frozen=True, eq=False)
class ArrayRecordings:
    """Episodes held in memory, columns already in the order of the channels; the arrays are made read-only."""

    values: Mapping[EpisodeKey, npt.NDArray[np.float64]]
    times: Mapping[EpisodeKey, npt.NDArray[np.float64]] | None = None

    def __post_init__(self) -> None:
        """Protect the samples, which every reader of the population shares."""
        for values in self.values.values():
            values.flags.writeable = False

    def __call__(self, key: EpisodeKey) -> Recording:
        """Return one episode."""
        return Recording(key, look_up(self.values, key), None if self.times is None else self.times[key])

    def restricted(self, keys: Iterable[EpisodeKey]) -> ArrayRecordings:
        """Return the same for fewer episodes, cheaper to send to another process."""
        wanted = tuple(keys)
        times = None if self.times is None else {key: self.times[key] for key in wanted}
        return ArrayRecordings({key: self.values[key] for key in wanted}, times)


def from_arrays(
    data: Any,
    channels: Sequence[Channel],
    sample_period_s: float,
    *,
    units: Iterable[Unit] = (),
    metadata: Mapping[str, Any] | None = None,
) -> Population:
    """Make a population from arrays.

    Parameters
    ----------
    data : mapping or sequence
        One of: ``{EpisodeKey: episode}``; ``{unit: [episode, ...]}``; ``{unit: {condition: [episode, ...]}}``; the same with a mapping from
        episode id in place of a list; or a list in place of the outer mapping, which numbers the units from zero. An episode is an array
        of shape (n_samples, n_channels), columns as in `channels`, or a pair (states, inputs).
    channels : sequence of Channel
        In the order of the columns; states are moved before inputs.
    sample_period_s : float
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
    >>> from kros.data import Channel, Role, from_arrays
    >>> channels = (Channel("x", Role.STATE, measured=True), Channel("u", Role.INPUT))
    >>> from_arrays({"a": [np.eye(4, 2)], "b": [np.eye(4, 2)]}, channels, 0.01).unit_ids
    ('a', 'b')
    """
    check_period(sample_period_s, "from_arrays")
    order = sorted(range(len(channels)), key=lambda i: channels[i].role is Role.INPUT)
    pairs = list(_episodes(data))
    values = {key: np.ascontiguousarray(_samples(key, episode, channels)[:, order]) for key, episode in pairs}
    facts = {unit.id: unit for unit in units}
    names = dict.fromkeys(key.unit for key, _ in pairs)
    found = [facts.get(name, Unit(name)) for name in names]
    ordered = tuple(channels[i] for i in order)
    return assemble(Recorded(ordered, found, [key for key, _ in pairs], ArrayRecordings(values), sample_period_s, dict(metadata or {})))


def as_numbers(values: Any) -> npt.NDArray[np.float64]:
    """Return an array of doubles; text, complex numbers and dates are refused rather than converted.

    Raises
    ------
    TypeError, ValueError, OverflowError
        With the reason.
    """
    found = np.asarray(values)
    kind = found.dtype.kind
    if kind not in "biufO" or (kind == "O" and any(isinstance(v, (str, bytes, complex)) for v in found.ravel().tolist())):
        raise TypeError(f"{'text or complex numbers' if kind == 'O' else found.dtype} cannot be used as real numbers")
    return np.asarray(found, dtype=float)


def _named(items: Any) -> Iterator[tuple[Any, Any]]:
    if isinstance(items, Mapping):
        yield from items.items()
    elif isinstance(items, Iterable) and not isinstance(items, str | bytes) and getattr(items, "shape", True):
        yield from ((str(i), item) for i, item in enumerate(items))
    else:
        raise DataError(f"from_arrays needs mappings or lists of episodes, found {shortened(repr(items))}; see its documentation.")


def _episodes(data: Any) -> Iterator[tuple[EpisodeKey, Any]]:
    for unit, of_unit in _named(data):
        if isinstance(unit, EpisodeKey):
            yield unit, of_unit
        elif isinstance(of_unit, Mapping) and any(isinstance(v, (Mapping, list)) for v in of_unit.values()):
            for condition, episodes in of_unit.items():
                yield from ((EpisodeKey(str(unit), str(condition), str(name)), episode) for name, episode in _named(episodes))
        else:
            yield from ((EpisodeKey(str(unit), DEFAULT_CONDITION, str(name)), episode) for name, episode in _named(of_unit))


def _samples(key: EpisodeKey, episode: Any, channels: Sequence[Channel]) -> npt.NDArray[np.float64]:
    try:
        parts = [as_numbers(part) for part in (episode if isinstance(episode, tuple) else (episode,))]
        values = parts[0] if len(parts) == 1 else np.column_stack(parts)
    except (ValueError, TypeError, OverflowError, RecursionError) as error:
        raise DataError(
            f"{title(key)}: needs numbers of shape (n_samples, {len(channels)}), found something else ({error}); correct the array."
        ) from error
    if values.ndim != 2 or values.shape[1] != len(channels):
        raise DataError(
            f"{title(key)}: needs shape (n_samples, {len(channels)}) for the channels {[c.name for c in channels]}, "
            f"found {values.shape}; transpose or correct the array."
        )
    return values
