"""Results of earlier maps, kept by what they were computed from, so that a run whose recordings grew computes what is new alone.

    task --mark--> known already: read back from <run>/seen/<map>.gz
                   new or changed: computed, and kept beside the others

A mark is a digest of everything that a result follows from, beside the code, whose key is the first line of the file. Nothing is believed that
cannot be read back whole: a damaged file is as good as none. Numbers come back bit by bit, so that results do not tell how they were obtained.
"""

from __future__ import annotations

import base64
import dataclasses
import gzip
import json
import logging
import zlib
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass, replace
from itertools import islice
from pathlib import Path
from typing import Any, TypeVar
from urllib.parse import quote

import numpy as np

from ...core import limits
from ...core.work import Usable, Work

T = TypeVar("T")
log = logging.getLogger(__name__)
_BLOCK = 1 << 20
_DAMAGED = (OSError, EOFError, ValueError, LookupError, TypeError, AttributeError, zlib.error)
_LEVEL = 1  # of compression


@dataclass(frozen=True)
class KnownResults:
    """What was computed earlier."""

    folder: Path
    key: str
    changed: Callable[[Path], None] | None = None

    def read_only(self) -> KnownResults:
        """Return the same, which keeps nothing new."""
        return replace(self, changed=None)

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
        """Yield results in the order of the tasks; see `Work.recall`."""
        known, named = self._read(title), {kind.__name__: kind for kind in kinds}
        found: list[Any] = [
            self._restored(known, mark, named, usable, task) for task, mark in zip(tasks, marks, strict=True)
        ]
        new = [(mark, task) for mark, task, result in zip(marks, tasks, found, strict=True) if result is None]
        keeps = self.changed is not None
        computed = work.map(title, _Packing(function, keeps), new)
        if not new and set(marks) == set(known):
            yield from found
            return
        log.info("%s: %d of %d are new or changed", title, len(new), len(tasks))
        left, fresh = dict(known), set[str]()
        with self._kept(title, fresh) as keep:
            try:
                for mark, result in zip(marks, found, strict=True):
                    value, member = next(computed) if result is None else (result, b"")
                    if mark is not None and keeps:
                        text = left.pop(mark, "") if result is not None else ""
                        keep(member or _member(mark, text or _text(value)))
                        fresh |= set() if text else {mark}
                    yield value
                next(computed, None)  # its progress is told to the end
            except BaseException:  # where it ends early, all that is known stays known
                for mark in left.keys() - fresh:
                    keep(_member(mark, left[mark]))
                raise

    def _path(self, title: str) -> Path:
        return self.folder / f"{quote(title, safe=' ()')}.gz"

    def _read(self, title: str) -> dict[str, str]:
        """Return results by their marks, as text."""
        path = self._path(title)
        if not path.is_file():
            return {}
        try:
            with gzip.open(path, "rb") as packed:
                text = b"".join(islice(iter(lambda: packed.read(_BLOCK), b""), limits.MAX_JSON_BYTES // _BLOCK + 1))
            if len(text) > limits.MAX_JSON_BYTES:
                raise ValueError(f"more than {limits.MAX_JSON_BYTES} bytes, unpacked")
            key, *lines = text.decode().removesuffix("\n").split("\n")
            return {mark: text for mark, _, text in (line.partition("\t") for line in lines)} if key == self.key else {}
        except _DAMAGED as error:
            log.warning("%s: cannot be read (%s), so everything is computed", path, error)
            return {}

    def _restored(
        self, known: Mapping[str, str], mark: str | None, kinds: Mapping[str, type], usable: Usable | None, task: Any
    ) -> Any:
        if mark is None or mark not in known:
            return None
        try:
            value = _unpacked(json.loads(known[mark]), kinds)
        except _DAMAGED as error:
            log.warning("%s: a result cannot be read (%s), and is computed again", self.folder, error)
            return None
        return value if usable is None or usable(task, value) else None

    @contextmanager
    def _kept(self, title: str, fresh: set[str]) -> Iterator[Callable[[bytes], object]]:
        """Give what writes one result; the file is in its place once all are there, and where it ends early if there are fresh ones."""
        if self.changed is None:
            yield lambda member: None
            return
        path = self._path(title)
        temporary = path.with_name(f".{path.name}")
        above = [folder for folder in (path.parent, path.parent.parent) if not folder.exists()]
        path.parent.mkdir(parents=True, exist_ok=True)
        try:
            with temporary.open("wb") as file:
                file.write(_compressed(f"{self.key}\n"))
                yield file.write
        except BaseException:
            with suppress(OSError):
                if fresh:
                    self._place(temporary, path)
                else:
                    temporary.unlink(missing_ok=True)
                    for folder in above:
                        folder.rmdir()
            raise
        self._place(temporary, path)

    def _place(self, temporary: Path, path: Path) -> None:
        temporary.replace(path)
        assert self.changed is not None
        self.changed(path)


@dataclass(frozen=True)
class _Packing:
    """A function that returns its result and, where it is kept, the result as it is written: one process would be busy packing those of all workers."""

    function: Callable[[Any], Any]
    kept: bool

    def __call__(self, marked: tuple[str | None, Any]) -> tuple[Any, bytes]:
        mark, task = marked
        value = self.function(task)
        return value, b"" if mark is None or not self.kept else _member(mark, _text(value))


def _member(mark: str, text: str) -> bytes:
    return _compressed(f"{mark}\t{text}\n")


def _compressed(line: str) -> bytes:
    """A file is many of these; without a name and a time, the bytes depend on the content alone."""
    return gzip.compress(line.encode(), _LEVEL, mtime=0)


def _text(value: Any) -> str:
    return json.dumps(_packed(value), separators=(",", ":"))


def _packed(value: Any) -> Any:
    """Turn a result into what JSON can hold: arrays and bytes in base 64, everything else under the name of its kind."""
    if value is None or type(value) in (str, int, bool, float):
        return value
    if isinstance(value, np.ndarray | np.generic):
        kind = "array" if isinstance(value, np.ndarray) else "number"
        return {kind: [value.dtype.str, value.shape, base64.b64encode(value.tobytes()).decode()]}
    if isinstance(value, bytes):
        return {"bytes": base64.b64encode(value).decode()}
    if dataclasses.is_dataclass(value):
        return {
            "is": type(value).__name__,
            "with": {f.name: _packed(getattr(value, f.name)) for f in dataclasses.fields(value)},
        }
    if isinstance(value, tuple):
        return {"tuple": [_packed(v) for v in value]}
    if isinstance(value, dict):
        return {"dict": {k: _packed(v) for k, v in value.items()}}
    if isinstance(value, list):
        return [_packed(v) for v in value]
    raise TypeError(f"Keeping a result: {type(value).__name__} is of no kind that can be kept.")


def _unpacked(value: Any, kinds: Mapping[str, type]) -> Any:
    if isinstance(value, list):
        return [_unpacked(v, kinds) for v in value]
    if not isinstance(value, dict):
        return value
    if "is" in value:
        return kinds[value["is"]](**{name: _unpacked(v, kinds) for name, v in value["with"].items()})
    ((kind, content),) = value.items()
    if kind in ("array", "number"):
        dtype, shape, text = content
        found = np.frombuffer(base64.b64decode(text), np.dtype(dtype)).reshape(shape).copy()
        return found if kind == "array" else found[()]
    if kind == "bytes":
        return base64.b64decode(content)
    if kind == "tuple":
        return tuple(_unpacked(v, kinds) for v in content)
    return {k: _unpacked(v, kinds) for k, v in content.items()}
