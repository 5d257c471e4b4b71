"""Marks of recordings: what the samples of an episode follow from, without reading them.

An episode follows from its file, known by path, size and time as whole runs are, from where in the file it is, and from how
it is read and prepared.
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
    """Return a mark of every group of episodes; None where the recordings are in no file."""
    about: list[Any] = []
    while isinstance(source, PreparedSource | EvenRecordings):
        if isinstance(source, PreparedSource):
            about.append((source.channels, source.period_s, source.steps, source.gaps))
        source = source.recordings if isinstance(source, PreparedSource) else source.source
    if not isinstance(source, Recordings):
        return [None for _ in groups]
    settings = [(f.name, getattr(source, f.name)) for f in dataclasses.fields(source) if f.name != "places"]
    stamp, how = lru_cache(maxsize=64)(_stamp), mark_of(about, type(source).__name__, settings, declared)

    def mark(keys: Sequence[EpisodeKey]) -> str | None:
        files = [source.file(source.places[key]) for key in keys]
        rows = [
            (key, source.places[key], stamp(file)) for key, file in zip(keys, files, strict=True) if file is not None
        ]
        return mark_of(how, rows) if len(rows) == len(keys) else None

    return [mark(keys) for keys in groups]


def _stamp(file: Path) -> tuple[int, int]:
    """Return size and time of change of a file."""
    status = file.stat()
    return status.st_size, status.st_mtime_ns
