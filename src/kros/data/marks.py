"""Marks of recordings: what the samples of an episode follow from, told without reading them.

An episode follows from its file, known by path, size and time as whole runs are, from where in the file it is, and from how it is read and prepared.
"""

from __future__ import annotations

import dataclasses
import hashlib
from collections.abc import Iterable, Sequence
from functools import lru_cache
from pathlib import Path
from typing import Any

from .population import EpisodeKey
from .prepare import EvenRecordings, PreparedSource
from .recording import Recordings


def mark_of(*content: Any) -> str:
    """Return a digest of plain content, dataclasses among it by their `repr`.

    Examples
    --------
    >>> from kros.data.marks import mark_of
    >>> mark_of("unit 7", 3) == mark_of("unit 7", 3) != mark_of("unit 7", 4)
    True
    """
    return hashlib.sha256(repr(content).encode()).hexdigest()


def recording_marks(source: Any, groups: Iterable[Sequence[EpisodeKey]], *declared: Any) -> list[str | None]:
    """Return a mark of every group of episodes.

    Parameters
    ----------
    source : callable
        That of a `Population`.
    groups : iterable of sequences of EpisodeKey
    *declared
        What else a result follows from.

    Returns
    -------
    list of str or None
        None for all where recordings are in no files, or in those of a reader that does not name them.

    Examples
    --------
    >>> from tempfile import TemporaryDirectory
    >>> import kros
    >>> from kros.data.marks import recording_marks
    >>> motors = kros.plants.DcMotorPopulation(n_units=2, n_episodes=2, seconds=1.0, seed=3).simulate().population
    >>> with TemporaryDirectory() as folder:
    ...     kros.data.write_parquet(motors, f"{folder}/recordings")
    ...     written = kros.read(f"{folder}/recordings")
    ...     marks = recording_marks(written.source, [written.keys(unit) for unit in written.unit_ids])
    >>> len(set(marks)), recording_marks(motors.source, [motors.keys("001")])
    (2, [None])
    """
    about: list[Any] = []
    while isinstance(source, PreparedSource | EvenRecordings):
        if isinstance(source, PreparedSource):
            about.append((source.channels, source.period_s, source.steps, source.tolerance, source.gaps))
            source = source.recordings
        else:
            source = source.source
    if not isinstance(source, Recordings):
        return [None for _ in groups]
    about.append((type(source).__name__, [(f.name, getattr(source, f.name)) for f in dataclasses.fields(source) if f.name != "places"]))
    stamp, how = lru_cache(maxsize=64)(_stamp), mark_of(about, declared)
    return [_mark(source, keys, how, stamp) for keys in groups]


def _mark(source: Recordings, keys: Sequence[EpisodeKey], how: str, stamp: Any) -> str | None:
    rows = []
    for key in keys:
        place = source.places[key]
        file = source.file(place)
        if file is None:
            return None
        rows.append((key, place, stamp(file)))
    return mark_of(how, rows)


def _stamp(file: Path) -> tuple[int, int]:
    status = file.stat()
    return status.st_size, status.st_mtime_ns
