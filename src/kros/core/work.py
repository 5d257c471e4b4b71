"""Independent pieces of work, in order: where they run, which results are there, and who listens to their progress."""

from __future__ import annotations

import logging
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, field
from typing import Any, TypeVar

from .results import Results, Storing

T = TypeVar("T")
log = logging.getLogger(__name__)


class Executor:
    """Maps a function over tasks: here, one behind the other; others derive from it."""

    def map(self, function: Callable[[Any], T], tasks: Iterable[Any]) -> Iterator[T]:
        """Yield results in the order of the tasks."""
        return map(function, tasks)


class Progress:
    """Listens to which part of a computation runs and how far it is; this one ignores everything."""

    def start(self, stage: str, total: int | None) -> None:
        """A stage (or a part of one) begins."""

    def advance(self) -> None:
        """One of its steps is done."""

    def finish(self, stage: str, seconds: float, skipped: bool) -> None:
        """A stage is done, or was skipped."""


@dataclass(frozen=True)
class Work:
    """An executor, a progress listener and earlier results; by default work runs here, in silence, without results."""

    executor: Executor = field(default_factory=Executor)
    progress: Progress = field(default_factory=Progress)
    results: Results | None = None

    def map(self, title: str, function: Callable[[Any], T], tasks: Iterable[Any]) -> Iterator[T]:
        """Map a function over tasks, in order."""
        tasks = list(tasks)
        return self._followed(title, len(tasks), self.executor.map(function, tasks))

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
        kinds: Iterable[type] = (),
        usable: Callable[[Any, Any], bool] = lambda task, result: True,
    ) -> Iterator[T]:
        """Map a function over tasks, in order, but for results that are there by the digests of tasks, `marks`."""
        if self.results is None:
            yield from self.map(title, function, tasks)
            return
        tasks, kinds, digests = list(tasks), tuple(kinds), self.results.digests(function, marks)
        earlier: list[Any] = []
        for task, digest in zip(tasks, digests, strict=True):
            result = self.results.read(digest, kinds)
            earlier.append(result if result is not None and usable(task, result) else None)
        new = [row for row, result in zip(zip(digests, tasks, strict=True), earlier, strict=True) if result is None]
        if new:
            log.info("%s: %d of %d are new or changed", title, len(new), len(tasks))
        computed = self.map(title, Storing(function, self.results.folder), new)
        for result in earlier:
            yield next(computed) if result is None else result
        next(computed, None)  # its progress ends

    def run(self, title: str, work: Iterable[Callable[[], T]]) -> list[T]:
        """Run independent pieces of work, in order."""
        return list(self.map(title, _call, work))

    def begin(self, title: str, work: Iterable[Callable[[], T]]) -> Callable[[], list[T]]:
        """Begin independent pieces of work, and return what waits for their results; other work may run meanwhile."""
        pieces = list(work)
        running = self.executor.map(_call, pieces)
        return lambda: list(self._followed(title, len(pieces), running))


def _call(work: Callable[[], T]) -> T:
    return work()
