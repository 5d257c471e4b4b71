"""Independent pieces of work, in order: where they run, what is known of them, and who is told how far they are."""

from __future__ import annotations

import logging
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, field
from typing import Any, Protocol, TypeVar

from .results import Results, Storing

T = TypeVar("T")
log = logging.getLogger(__name__)


class Executor(Protocol):
    """Maps a function over tasks, in order."""

    def map(self, function: Callable[[Any], T], tasks: Iterable[Any]) -> Iterator[T]:
        """Yield results in the order of the tasks."""
        ...


class SerialExecutor:
    """Runs every task in this process."""

    def map(self, function: Callable[[Any], T], tasks: Iterable[Any]) -> Iterator[T]:
        """Yield results in the order of the tasks."""
        return map(function, tasks)


class Progress(Protocol):
    """Told which part of a computation runs and how far it is."""

    def start(self, stage: str, total: int | None) -> None:
        """A stage (or a part of one) begins."""

    def advance(self) -> None:
        """One of its steps is done."""

    def finish(self, stage: str, seconds: float, skipped: bool) -> None:
        """A stage is done, or was found done."""


class Silent:
    """A progress listener that ignores everything."""

    def start(self, stage: str, total: int | None) -> None:
        """Ignore."""

    def advance(self) -> None:
        """Ignore."""

    def finish(self, stage: str, seconds: float, skipped: bool) -> None:
        """Ignore."""


@dataclass(frozen=True)
class Work:
    """An executor, a progress listener and results that are there; by default everything runs here, in silence, and nothing is known."""

    executor: Executor = field(default_factory=SerialExecutor)
    progress: Progress = field(default_factory=Silent)
    results: Results | None = None

    def map(self, title: str, function: Callable[[Any], T], tasks: Iterable[Any]) -> Iterator[T]:
        """Map a function over tasks, in order."""
        tasks = list(tasks)
        self.progress.start(title, len(tasks))
        for result in self.executor.map(function, tasks):
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
        """Map a function over tasks, in order; what is in the store by the digest (`marks`) of all that a task holds, and is usable, is not computed."""
        if self.results is None:
            yield from self.map(title, function, tasks)
            return
        tasks, kinds, digests = list(tasks), tuple(kinds), self.results.digests(function, marks)
        known = [self.results.read(digest, kinds) for digest in digests]
        known = [
            None if result is None or not usable(task, result) else result
            for task, result in zip(tasks, known, strict=True)
        ]
        new = [row for row, result in zip(zip(digests, tasks, strict=True), known, strict=True) if result is None]
        if new:
            log.info("%s: %d of %d are new or changed", title, len(new), len(tasks))
        computed = self.map(title, Storing(function, self.results.folder), new)
        for result in known:
            yield next(computed) if result is None else result
        next(computed, None)  # its progress is told to the end

    def run(self, title: str, work: Iterable[Callable[[], T]]) -> list[T]:
        """Run independent pieces of work, in order."""
        return list(self.map(title, _call, work))

    def begin(self, title: str, work: Iterable[Callable[[], T]]) -> Callable[[], list[T]]:
        """Begin independent pieces of work, and return what waits for their results, in order: work that is asked for meanwhile runs beside them."""
        pieces = list(work)
        running = self.executor.map(_call, pieces)

        def results() -> list[T]:
            self.progress.start(title, len(pieces))
            found = []
            for result in running:
                self.progress.advance()
                found.append(result)
            return found

        return results


def _call(work: Callable[[], T]) -> T:
    return work()
