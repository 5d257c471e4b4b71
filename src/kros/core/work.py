"""Independent pieces of work, in order: where they run, which results are there, and who listens to their progress.

Results of maps are in a store, by the digest of all that they follow from. The process that computes a result writes
it, on a cluster too. Numbers come back bit by bit; what cannot be read back whole is computed again.
"""

import json
import logging
from collections.abc import Callable, Iterable, Iterator
from dataclasses import field
from functools import partial
from operator import call
from pathlib import Path
from typing import Any

import numpy as np

from .arrays import T, frozen
from .artifacts import digest_of, divided, json_bytes, pack_arrays, united, unpack_arrays
from .errors import DataError
from .files import read_bytes, write_bytes
from .limits import MAX_ARRAYS_BYTES

log = logging.getLogger(__name__)


# what maps a function over tasks, as `map` does: results are in the order of the tasks
Mapped = Callable[..., Iterator[Any]]


class Progress:
    """Listens to which part of a computation runs and how far it is; this one ignores everything."""

    def start(self, stage: str, total: int | None) -> None:
        """A stage (or a part of one) begins."""

    def advance(self) -> None:
        """One of its steps is done."""

    def finish(self, stage: str, seconds: float, skipped: bool) -> None:
        """A stage is done, or was skipped."""


@frozen
class Results:
    """Results in a folder, computed with the `source` of kros; `used` are those of the maps so far."""

    folder: Path
    source: str
    used: set[str] = field(default_factory=set)

    def place(self, function: Callable[[Any], Any], mark: str | None) -> Path | None:
        """Return where the result of a task is, by a digest of what it holds; None where a task has none."""
        if mark is None:
            return None
        digest = digest_of(self.source, f"{function.__module__}.{function.__qualname__}", mark)
        self.used.add(digest)
        return self.folder / f"{digest}.npz"


def _read(path: Path | None, kind: Any, usable: Callable[[Any], bool]) -> Any:
    """Return a result that is usable, or None where there is none or it cannot be read."""
    if path is None or not path.exists():
        return None
    try:
        arrays = unpack_arrays(read_bytes(path, MAX_ARRAYS_BYTES), path)
        result = united(kind, json.loads(arrays["content"].tobytes()), arrays)
    except (DataError, ValueError, LookupError, TypeError, AttributeError) as error:
        log.warning("%s: a result cannot be read (%s), and is computed again", path, error)
        return None
    return result if usable(result) else None


def stored(function: Callable[[Any], T], task: tuple[Path | None, Any]) -> T:
    """Return the result of a task, which is written where it has a path."""
    path, content = task
    result = function(content)
    if path is not None:
        text, arrays = divided(result)
        write_bytes(path, pack_arrays({"content": np.frombuffer(json_bytes(text), np.uint8), **arrays}))
    return result


@frozen
class Work:
    """What maps, a progress listener and earlier results; by default work runs here, in silence, without results."""

    mapped: Mapped = map
    progress: Progress = field(default_factory=Progress)
    results: Results | None = None

    def map(self, title: str, function: Callable[[Any], T], tasks: Iterable[Any]) -> Iterator[T]:
        """Map a function over tasks, in order."""
        tasks = list(tasks)
        return self._followed(title, len(tasks), self.mapped(function, tasks))

    def _followed(self, title: str, total: int, results: Iterator[T]) -> Iterator[T]:
        """Yield results, and report progress."""
        self.progress.start(title, total)
        for result in results:
            self.progress.advance()
            yield result

    def recall(
        self,
        title: str,
        function: Callable[[Any], T],
        tasks: Iterable[Any],
        marks: Iterable[str | None],
        kind: Any = Any,
        usable: Callable[[Any], bool] = lambda result: True,
    ) -> Iterator[T]:
        """Map a function over tasks, in order, but for results of a kind that are there by digests of tasks."""
        if self.results is None:
            yield from self.map(title, function, tasks)
            return
        pairs = [(self.results.place(function, mark), task) for mark, task in zip(marks, tasks, strict=True)]
        earlier = [_read(path, kind, usable) for path, _ in pairs]
        new = [pair for pair, result in zip(pairs, earlier, strict=True) if result is None]
        if new:
            log.info("%s: %d of %d are new or changed", title, len(new), len(pairs))
        computed = self.map(title, partial(stored, function), new)
        for result in earlier:
            yield next(computed) if result is None else result
        next(computed, None)  # its progress ends

    def run(self, title: str, work: Iterable[Callable[[], T]]) -> list[T]:
        """Run independent pieces of work, in order."""
        return self.begin(title, work)()

    def begin(self, title: str, work: Iterable[Callable[[], T]]) -> Callable[[], list[T]]:
        """Begin independent pieces of work, and return what waits for their results; other work may run meanwhile."""
        results = self.map(title, call, work)
        return lambda: list(results)


def grouped(items: Iterable[T], by: Callable[[T], Any]) -> dict[Any, list[T]]:
    """Return items by what they share, in order."""
    groups = dict[Any, list[T]]()
    for item in items:
        groups.setdefault(by(item), []).append(item)
    return groups
