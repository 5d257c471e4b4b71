"""The one reader and writer behind every `save` and `load`.

An artifact is a folder with `arrays.npz` (no pickle) and `<kind>.json` (readable, with a schema version and a checksum
of both). Files appear whole or not at all: they are written beside their place and moved there. What was changed since
is not read: a file that was edited on purpose is accepted once its key ``checksum`` is removed, and its reader checks it.
"""

from __future__ import annotations

import dataclasses
import datetime
import enum
import hashlib
import json
import math
import os
import tempfile
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from . import limits
from .archive import pack_arrays, unpack_arrays
from .errors import DataError
from .files import TEMPORARY, read_bytes, shortened

SCHEMA = 1
CHECKSUM = "checksum"


class LoadedContent(dict[Any, Any]):
    """A JSON object or a set of arrays as read from a file; a key that is missing is an error that names the file."""

    def __init__(self, content: Mapping[Any, Any], path: Path) -> None:
        super().__init__(content)
        self.path = path

    def __missing__(self, key: Any) -> Any:
        raise DataError(
            f"Reading {self.path}: key {key!r} is missing, found {shortened(str(list(self)))}; write it again with "
            "this version."
        )


def write_bytes(path: Path, content: bytes) -> None:
    """Write a file so that a reader sees the old content or the new, never half of it."""
    path.parent.mkdir(parents=True, exist_ok=True)
    handle, temporary = tempfile.mkstemp(dir=path.parent, prefix=TEMPORARY)
    try:
        with os.fdopen(handle, "wb") as file:
            file.write(content)
        Path(temporary).chmod(0o644)
        Path(temporary).replace(path)
    except BaseException:
        Path(temporary).unlink(missing_ok=True)
        raise


def plain(value: Any) -> Any:
    """Turn dataclasses, enums, NumPy scalars and arrays into JSON's own types; NaN and infinity become null."""
    if isinstance(value, enum.Enum):
        return plain(value.value)
    if isinstance(value, float):
        return value if math.isfinite(value) else None
    if value is None or isinstance(value, str | int):
        return value
    if isinstance(value, Mapping):
        return {key if type(key) is str else str(plain(key)): plain(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [plain(item) for item in value]
    if isinstance(value, np.ndarray | np.generic):
        return plain(value.tolist())
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        return {f.name: plain(getattr(value, f.name)) for f in dataclasses.fields(value)}
    if isinstance(value, datetime.date | datetime.time):  # of TOML
        return value.isoformat()
    return str(value) if isinstance(value, Path) else value


def json_bytes(content: Any) -> bytes:
    """Return JSON with a stable layout."""
    return (json.dumps(plain(content), indent=1, ensure_ascii=False, allow_nan=False) + "\n").encode()


def write_json(path: Path, content: Any) -> None:
    """Write JSON with a stable layout."""
    write_bytes(path, json_bytes(content))


def read_json(path: Path) -> Any:
    """Read a JSON file, or say which file is missing or broken; its objects are `LoadedContent`."""
    path = Path(path)
    text = _read(path, limits.MAX_JSON_BYTES)

    def loaded(content: dict[str, Any]) -> LoadedContent:
        return LoadedContent(content, path)

    try:
        return json.loads(text.decode(), object_hook=loaded, parse_constant=_refuse, parse_float=_finite)
    except (ValueError, RecursionError) as error:
        raise DataError(
            f"Reading {path}: not valid JSON ({shortened(str(error))}); write it again with the step that made it."
        ) from error


def _refuse(constant: str) -> Any:
    raise ValueError(f"{constant} is not a number of JSON")


def _finite(text: str) -> float:
    value = float(text)
    if not math.isfinite(value):
        raise ValueError(f"{text} is too large")
    return value


def _digest(content: Mapping[str, Any]) -> str:
    content = {key: value for key, value in content.items() if key != CHECKSUM}
    return "sha256:" + hashlib.sha256(json.dumps(content, sort_keys=True, separators=(",", ":")).encode()).hexdigest()


def with_checksum(content: Mapping[str, Any]) -> dict[str, Any]:
    """Return the content, in JSON's own types, with its checksum as the last key."""
    whole: dict[str, Any] = plain(content)
    return {**whole, CHECKSUM: _digest(whole)}


def check_checksum(content: Mapping[str, Any], path: Path) -> bool:
    """Refuse content of `read_json` that is not what its checksum says; False where it has none."""
    if CHECKSUM not in content:
        return False
    if content[CHECKSUM] != _digest(content):
        raise DataError(
            f"Reading {path}: the content does not fit its checksum, so it was changed or damaged since it was "
            "written; write it again, or "
            f'remove the key "{CHECKSUM}" where it was edited on purpose.'
        )
    return True


def read_arrays(path: Path) -> dict[str, np.ndarray]:
    """Read all arrays of an .npz; pickled objects and packed archives are refused."""
    path = Path(path)
    return LoadedContent(unpack_arrays(_read(path, limits.MAX_ARRAYS_BYTES), path), path)


def _read(path: Path, limit: int) -> bytes:
    if not path.exists():
        raise DataError(f"Reading {path.name}: there is no file {path}; is this the folder that an earlier step wrote?")
    return read_bytes(path, limit)


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
        raise DataError(
            f"Loading {kind} from {folder}: schema and kind should be {(SCHEMA, kind)}, found {about}; write it again "
            "with this version of kros."
        )
    check_checksum(content, path)
    content.pop(CHECKSUM, None)
    digest = content.pop("arrays", None)
    if digest is None and not archive.exists():
        return content, LoadedContent({}, archive)
    packed = _read(archive, limits.MAX_ARRAYS_BYTES)
    if digest is not None and hashlib.sha256(packed).hexdigest() != digest:
        raise DataError(
            f"Reading {archive}: it is not the file that {path.name} was written with; write both again with the step "
            "that made them."
        )
    return content, LoadedContent(unpack_arrays(packed, archive), archive)
