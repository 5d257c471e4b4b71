"""Results of maps in a store, by the digest of all that they follow from: what is new is computed, the rest is read.

The process that computes a result writes it, on a cluster too. Numbers come back bit by bit, so results do not depend
on how they were obtained; what cannot be read back whole is computed again.
"""

from __future__ import annotations

import dataclasses
import json
import logging
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from .archive import pack_arrays, unpack_arrays
from .errors import DataError
from .files import read_bytes, write_bytes
from .limits import MAX_ARRAYS_BYTES
from .store import digest_of

log = logging.getLogger(__name__)


@dataclass(frozen=True)
class Results:
    """Results in a folder, computed with the `source` of kros; `used` are those of the maps so far."""

    folder: Path
    source: str
    used: set[str] = field(default_factory=set)

    def digests(self, function: Callable[[Any], Any], of_tasks: Iterable[str | None]) -> list[str | None]:
        """Return the digests of results from those of what the tasks hold; None where a task has none."""
        name = f"{function.__module__}.{function.__qualname__}"
        digests = [None if digest is None else digest_of(self.source, name, digest) for digest in of_tasks]
        self.used.update(digest for digest in digests if digest is not None)
        return digests

    def read(self, digest: str | None, kinds: Iterable[type]) -> Any:
        """Return a result, or None."""
        path = self.folder / f"{digest}.npz"
        if digest is None or not path.exists():
            return None
        try:
            return unpacked(read_bytes(path, MAX_ARRAYS_BYTES), path, {kind.__name__: kind for kind in kinds})
        except (DataError, ValueError, LookupError, TypeError, AttributeError) as error:
            log.warning("%s: a result cannot be read (%s), and is computed again", path, error)
            return None


@dataclass(frozen=True)
class Storing:
    """A function of a digest and a task, whose result is written where it has a digest."""

    function: Callable[[Any], Any]
    folder: Path

    def __call__(self, task: tuple[str | None, Any]) -> Any:
        """Compute."""
        result = self.function(task[1])
        if task[0] is not None:
            write_bytes(self.folder / f"{task[0]}.npz", packed(result))
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
        return [
            type(value).__name__,
            {f.name: _plain(getattr(value, f.name), arrays) for f in dataclasses.fields(value)},
        ]
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
