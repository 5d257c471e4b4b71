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
    """Return a digest of plain content, dataclasses among it by their `repr`."""
    return hashlib.sha256(repr(content).encode()).hexdigest()


def recording_marks(source: Any, groups: Iterable[Sequence[EpisodeKey]], *declared: Any) -> list[str | None]:
    """Return a mark of every group of episodes."""
    about: list[Any] = []
    while isinstance(source, PreparedSource | EvenRecordings):
        if isinstance(source, PreparedSource):
            about.append((source.channels, source.period_s, source.steps, source.gaps))
            source = source.recordings
        else:
            source = source.source
    if not isinstance(source, Recordings):
        return [None for _ in groups]
    about.append(
        (
            type(source).__name__,
            [(f.name, getattr(source, f.name)) for f in dataclasses.fields(source) if f.name != "places"],
        )
    )
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
