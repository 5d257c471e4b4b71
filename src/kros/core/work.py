"""Independent pieces of work, in order: where they run, and who is told how far they are."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, field
from typing import Any, Protocol, TypeVar

T = TypeVar("T")


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
    """An executor and a progress listener; by default everything runs here, in silence."""

    executor: Executor = field(default_factory=SerialExecutor)
    progress: Progress = field(default_factory=Silent)

    def map(self, title: str, function: Callable[[Any], T], tasks: Iterable[Any]) -> Iterator[T]:
        """Map a function over tasks, in order."""
        tasks = list(tasks)
        self.progress.start(title, len(tasks))
        for result in self.executor.map(function, tasks):
            self.progress.advance()
            yield result

    def run(self, title: str, work: Iterable[Callable[[], T]]) -> list[T]:
        """Run independent pieces of work, in order."""
        return list(self.map(title, _call, work))


def _call(work: Callable[[], T]) -> T:
    return work()
