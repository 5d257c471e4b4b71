"""Artefacts: what is written and read, and folders of it that are named by the digest of all that they follow from.

    <folder>/arrays.npz, <kind>.json    arrays (no pickle) and the rest, with a schema version and a checksum of both
    <run>/store/<digest>/               what a stage wrote, and `artefact.json`, which lists it
    <run>/store/<digest>.npz            the result of one task of a map; see `work`
    <run>/manifest.json                 the artefacts of a run; their files are at their places in the run folder too

A digest is of settings, inputs and source, so what is there need not be computed. Files appear whole or not at all.
What was changed since is not read; a JSON file that was edited on purpose is accepted without its key ``checksum``.
"""

from __future__ import annotations

import hashlib
import io
import json
import math
import struct
import tokenize
import zipfile
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from functools import wraps
from pathlib import Path, PurePosixPath, PureWindowsPath
from typing import Any, TypeVar

import numpy as np
from pydantic import Field, NonNegativeFloat
from pydantic_core import to_jsonable_python

from . import limits
from .errors import ConfigError, DataError, KrosError
from .files import is_file, pass_on_shortage, read_bytes, shortened, stamp_of, write_bytes
from .settings import Settings

T = TypeVar("T")
SCHEMA = 1
CHECKSUM = "checksum"
_AGAIN = "write it again with the step that made it"
_DAMAGED: tuple[type[Exception], ...] = (zipfile.BadZipFile, struct.error, tokenize.TokenError, SyntaxError, OSError)
_DAMAGED += (EOFError, ValueError, LookupError, TypeError, ArithmeticError, RuntimeError, MemoryError)


def plain(value: Any) -> Any:
    """Turn dataclasses, enums, dates and NumPy's arrays into JSON's own types; NaN and infinity become null."""
    return to_jsonable_python(value, inf_nan_mode="null", fallback=_plain)


def _plain(value: Any) -> Any:
    if isinstance(value, np.ndarray | np.generic):
        return value.tolist()
    if isinstance(value, Mapping):
        return dict(value)
    raise TypeError(f"{type(value).__name__} is not JSON serializable")


def json_bytes(content: Any) -> bytes:
    """Return JSON with a stable layout."""
    return (json.dumps(plain(content), indent=1, ensure_ascii=False, allow_nan=False) + "\n").encode()


def write_json(path: Path, content: Any) -> None:
    """Write JSON with a stable layout."""
    write_bytes(path, json_bytes(content))


def read_json(path: Path) -> Any:
    """Read a JSON file, or say which file is missing or broken."""
    text = read_bytes(Path(path), limits.MAX_JSON_BYTES)
    try:
        return json.loads(text.decode(), parse_constant=_finite, parse_float=_finite)
    except (ValueError, RecursionError) as error:
        raise DataError(f"Reading {path}: not valid JSON ({shortened(str(error))}); {_AGAIN}.") from error


def _finite(text: str) -> float:
    if math.isfinite(value := float(text)):
        return value
    raise ValueError(f"{text} is not a number of JSON")


def _digest(content: Mapping[str, Any]) -> str:
    content = {key: value for key, value in content.items() if key != CHECKSUM}
    return "sha256:" + hashlib.sha256(json.dumps(content, sort_keys=True, separators=(",", ":")).encode()).hexdigest()


def with_checksum(content: Mapping[str, Any]) -> dict[str, Any]:
    """Return the content, in JSON's own types, with its checksum as the last key."""
    whole: dict[str, Any] = plain(content)
    return {**whole, CHECKSUM: _digest(whole)}


def check_checksum(content: Mapping[str, Any], path: Path) -> bool:
    """Refuse content of `read_json` that is not what its checksum says; False where it has none."""
    if CHECKSUM in content and content[CHECKSUM] != _digest(content):
        problem = "the content does not fit its checksum, so it was changed or damaged since it was written"
        advice = f'write it again, or remove the key "{CHECKSUM}" where it was edited on purpose'
        raise DataError(f"Reading {path}: {problem}; {advice}.")
    return CHECKSUM in content


def pack_arrays(arrays: Mapping[str, np.ndarray]) -> bytes:
    """Return an .npz of arrays, without pickle and not compressed."""
    buffer = io.BytesIO()
    np.savez(buffer, allow_pickle=False, **arrays)
    return buffer.getvalue()


def unpack_arrays(packed: bytes, path: Path) -> dict[str, np.ndarray]:
    """Return what `pack_arrays` packed; compressed archives, pickled objects and what was changed are refused."""
    try:
        with np.load(io.BytesIO(packed), allow_pickle=False) as archive:
            if any(info.compress_type != zipfile.ZIP_STORED for info in archive.zip.infolist()):
                raise ValueError("it is compressed, which kros never does")
            arrays = {name: archive[name] for name in archive.files}
        if not all(isinstance(array, np.ndarray) for array in arrays.values()):
            raise ValueError("a part of it is no array")
        return arrays
    except _DAMAGED as error:
        pass_on_shortage(error, path)
        problem = f"not a valid archive of arrays ({error or type(error).__name__})"
        raise DataError(f"Reading {path}: {problem}; {_AGAIN}.") from error


def read_arrays(path: Path) -> dict[str, np.ndarray]:
    """Read all arrays of an .npz; pickled objects and packed archives are refused."""
    return unpack_arrays(read_bytes(Path(path), limits.MAX_ARRAYS_BYTES), path)


def save_artifact(
    folder: Path, kind: str, content: Mapping[str, Any], arrays: Mapping[str, np.ndarray] | None = None
) -> None:
    """Write `<kind>.json` (with schema version and checksum) and, where there are arrays, `arrays.npz`."""
    folder = Path(folder)
    whole = {"schema": SCHEMA, "kind": kind, **content}
    if arrays is not None:
        packed = pack_arrays(arrays)
        write_bytes(folder / "arrays.npz", packed)
        whole["arrays"] = hashlib.sha256(packed).hexdigest()
    write_json(folder / f"{kind}.json", with_checksum(whole))


def load_artifact(folder: Path, kind: str) -> tuple[dict[str, Any], dict[str, np.ndarray]]:
    """Read what `save_artifact` wrote and check kind, schema version and checksum."""
    folder = Path(folder)
    path, archive = folder / f"{kind}.json", folder / "arrays.npz"
    content = read_json(path)
    about = (content.get("schema"), content.get("kind")) if isinstance(content, dict) else None
    if about != (SCHEMA, kind):
        problem = f"schema and kind should be {(SCHEMA, kind)}, found {about}"
        raise DataError(f"Loading {kind} from {folder}: {problem}; write it again with this version of kros.")
    check_checksum(content, path)
    content.pop(CHECKSUM, None)
    digest = content.pop("arrays", None)
    if digest is None and not archive.exists():
        return content, {}
    packed = read_bytes(archive, limits.MAX_ARRAYS_BYTES)
    if digest is not None and hashlib.sha256(packed).hexdigest() != digest:
        raise DataError(f"Reading {archive}: it is not the file that {path.name} was written with; {_AGAIN}.")
    return content, unpack_arrays(packed, archive)


@contextmanager
def as_written(what: str, path: Path) -> Iterator[None]:
    """Turn what content of the wrong kind does to the code that reads it into one error."""
    try:
        yield
    except KrosError:
        raise
    except (LookupError, TypeError, ValueError, AttributeError, ArithmeticError, np.linalg.LinAlgError) as error:
        reason = f"{type(error).__name__}: {shortened(str(error))}"
        raise DataError(f"Loading {what} from {path}: not as kros writes it ({reason}); {_AGAIN}.") from error


def loader(load: Callable[[Any, Any], T]) -> Callable[[Any, Any], T]:
    """Wrap a ``load(cls, path)`` in `as_written`; applied below ``@classmethod``."""

    @wraps(load)
    def guarded(cls: Any, path: Any) -> T:
        with as_written(cls.__name__, Path(path)):
            return load(cls, path)

    return guarded


MANIFEST, INDEX = "manifest.json", "artefact.json"
Described = tuple[str, int, int]  # SHA-256, size in bytes, time of the last change in ns


class Artefact(Settings):
    """Files that follow from what `digest` is of."""

    digest: str = Field(pattern="^[0-9a-f]{64}$")
    seconds: NonNegativeFloat = 0.0  # that it took
    files: dict[str, Described] = Field(default_factory=dict)  # by name
    results: tuple[str, ...] = ()  # digests of the results that it was computed from

    @classmethod
    def read(cls, path: Path) -> Artefact:
        """Read one that was written as JSON."""
        return cls.of(_checked(path), f"Artefact {path}")

    def matches(self, folder: Path, name: str) -> bool:
        """Return whether a file is in a folder as it was written; one with its size and time is not read."""
        path, (content, *stamp) = place(folder, name), self.files[name]
        return is_file(path) and (stamp_of(path) == tuple(stamp) or file_digest(path) == content)


def digest_of(*content: object) -> str:
    """Return a digest of plain content, dataclasses among it by their `repr`."""
    return hashlib.sha256(repr(content).encode()).hexdigest()


def file_digest(path: Path) -> str:
    """Return the SHA-256 of a file."""
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def describe(path: Path) -> Described:
    """Return digest, size and time of a file."""
    return file_digest(path), *stamp_of(path)


def place(folder: Path, name: str) -> Path:
    """Return the path of a file in a folder; a name that leads out of it, directly or through a link, is refused."""
    parts = PurePosixPath(name).parts
    if not parts or ".." in parts or "/".join(parts) != name or PureWindowsPath(name).anchor or "\0" in name:
        raise DataError(f"Run folder {folder}: {name!r} is not the name of a file inside it.")
    for depth in range(1, len(parts)):
        path = folder.joinpath(*parts[:depth])
        if path.is_symlink():
            problem = f"{path} is a link, and results stay inside the folder"
            raise DataError(f"Run folder {folder}: {problem}; put a folder in its place.")
    return folder / name


def read_manifest(folder: Path) -> dict[str, Artefact]:
    """Return the artefacts of a run by stage; none where there is no manifest."""
    path = folder / MANIFEST
    if not is_file(path):
        return {}
    try:
        return {stage: Artefact.of(content, stage) for stage, content in _checked(path).items()}
    except (ConfigError, DataError, AttributeError, TypeError) as error:
        problem = f"is damaged, or of another version of kros ({error})"
        raise DataError(f"Manifest {path}: {problem}; run the study again.") from error


def _checked(path: Path) -> Mapping[str, object]:
    content = read_json(path)
    check_checksum(content, path)
    return {key: value for key, value in content.items() if key != CHECKSUM}


def write_manifest(folder: Path, artefacts: Mapping[str, Artefact]) -> None:
    """Write which artefacts a run has; what they were computed from stands in the store."""
    write_json(folder / MANIFEST, with_checksum({s: a.model_dump(exclude={"results"}) for s, a in artefacts.items()}))


def recorded_files(folder: Path) -> frozenset[str]:
    """Return the names of all files that belong to a run."""
    return frozenset().union(*(artefact.files for artefact in read_manifest(folder).values()))
