"""Independent pieces of work, in order: where they run, which results are there, and who listens to their progress.

Results of maps are in a store, by the digest of all that they follow from. The process that computes a result writes
it, on a cluster too. Numbers come back bit by bit; what cannot be read back whole is computed again.
"""

from __future__ import annotations

import dataclasses
import json
import logging
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, TypeVar

import numpy as np

from .artifacts import digest_of, pack_arrays, unpack_arrays
from .errors import DataError
from .files import read_bytes, write_bytes
from .limits import MAX_ARRAYS_BYTES

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


def _read(path: Path | None, kinds: Iterable[type]) -> Any:
    """Return a result, or None where there is none or it cannot be read."""
    if path is None or not path.exists():
        return None
    try:
        return unpacked(read_bytes(path, MAX_ARRAYS_BYTES), path, {kind.__name__: kind for kind in kinds})
    except (DataError, ValueError, LookupError, TypeError, AttributeError) as error:
        log.warning("%s: a result cannot be read (%s), and is computed again", path, error)
        return None


@dataclass(frozen=True)
class Storing:
    """A function of a path and a task, whose result is written where it has a path."""

    function: Callable[[Any], Any]

    def __call__(self, task: tuple[Path | None, Any]) -> Any:
        """Compute."""
        path, content = task
        result = self.function(content)
        if path is not None:
            write_bytes(path, packed(result))
        return result


def packed(value: Any) -> bytes:
    """Return a result as an archive of its arrays, beside JSON of all else."""
    arrays: list[np.ndarray] = []
    text = json.dumps(_plain(value, arrays)).encode()
    return pack_arrays({"content": np.frombuffer(text, np.uint8), **{str(i): a for i, a in enumerate(arrays)}})


def unpacked(content: bytes, path: Path, kinds: Mapping[str, type]) -> Any:
    """Return what `packed` packed; dataclasses are of some kinds."""
    arrays = unpack_arrays(content, path)
    return _restored(json.loads(arrays["content"].tobytes()), arrays, kinds)


def _plain(value: Any, arrays: list[np.ndarray]) -> Any:
    """Turn a value into what JSON can hold: what is not JSON's own becomes ``[kind, ...]``."""
    if value is None or type(value) in (str, int, bool, float):
        return value
    if isinstance(value, np.ndarray | np.generic):
        arrays.append(np.asarray(value))
        return ["array" if isinstance(value, np.ndarray) else "number", len(arrays) - 1, np.shape(value)]
    if dataclasses.is_dataclass(value):
        names = [f.name for f in dataclasses.fields(value)]
        return [type(value).__name__, {name: _plain(getattr(value, name), arrays) for name in names}]
    if isinstance(value, list | tuple):
        return [type(value).__name__, [_plain(v, arrays) for v in value]]
    if isinstance(value, dict):
        return ["dict", {k: _plain(v, arrays) for k, v in value.items()}]
    raise TypeError(f"Storing a result: {type(value).__name__} is of no kind that can be stored.")


def _restored(value: Any, arrays: Mapping[str, np.ndarray], kinds: Mapping[str, type]) -> Any:
    """Return what `_plain` turned into JSON."""
    if not isinstance(value, list):
        return value
    kind, content, *shape = value
    if shape:
        array = arrays[str(content)].reshape(shape[0])
        return array if kind == "array" else array[()]
    if isinstance(content, list):
        items = [_restored(v, arrays, kinds) for v in content]
        return tuple(items) if kind == "tuple" else items
    fields = {name: _restored(v, arrays, kinds) for name, v in content.items()}
    return fields if kind == "dict" else kinds[kind](**fields)


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
        kinds: Collection[type] = (),
        usable: Callable[[Any, Any], bool] = lambda task, result: True,
    ) -> Iterator[T]:
        """Map a function over tasks, in order, but for results that are there by the digests of tasks, `marks`."""
        if self.results is None:
            yield from self.map(title, function, tasks)
            return
        pairs = [(self.results.place(function, mark), task) for mark, task in zip(marks, tasks, strict=True)]
        read = [_read(path, kinds) for path, _ in pairs]
        earlier = [r if r is None or usable(task, r) else None for r, (_, task) in zip(read, pairs, strict=True)]
        new = [pair for pair, result in zip(pairs, earlier, strict=True) if result is None]
        if new:
            log.info("%s: %d of %d are new or changed", title, len(new), len(pairs))
        computed = self.map(title, Storing(function), new)
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
