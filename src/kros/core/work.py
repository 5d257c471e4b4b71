"""Independent pieces of work, in order: where they run, and who is told how far they are."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, field
from typing import Any, Protocol, TypeVar

T = TypeVar("T")
Usable = Callable[[Any, Any], bool]  # of a task and its result


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


class Recalls(Protocol):
    """Knows results of earlier maps."""

    def recall(
        self,
        work: Work,
        title: str,
        function: Callable[[Any], T],
        tasks: Sequence[Any],
        marks: Sequence[str | None],
        kinds: Iterable[type] = (),
        usable: Usable | None = None,
    ) -> Iterator[T]:
        """Yield results in the order of the tasks."""
        ...


@dataclass(frozen=True)
class Work:
    """An executor, a progress listener and what is known from earlier; by default everything runs here, in silence, and nothing is known."""

    executor: Executor = field(default_factory=SerialExecutor)
    progress: Progress = field(default_factory=Silent)
    seen: Recalls | None = None

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
        usable: Usable | None = None,
    ) -> Iterator[T]:
        """Map a function over tasks, in order, without those whose results are known from earlier."""
        if self.seen is None:
            return self.map(title, function, tasks)
        return self.seen.recall(self, title, function, list(tasks), list(marks), kinds, usable)

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
