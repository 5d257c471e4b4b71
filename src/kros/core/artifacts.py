"""The one reader and writer behind every `save` and `load`.

An artifact is a folder with `arrays.npz` (no pickle) and `<kind>.json` (readable, with a schema version).
Files appear whole or not at all: they are written beside their place and moved there.
"""

from __future__ import annotations

import dataclasses
import enum
import io
import json
import math
import os
import tempfile
import zipfile
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from .errors import DataError

SCHEMA = 1


def write_bytes(path: Path, content: bytes) -> None:
    """Write a file so that a reader sees the old content or the new, never half of it."""
    path.parent.mkdir(parents=True, exist_ok=True)
    handle, temporary = tempfile.mkstemp(dir=path.parent, prefix=f".{path.name}.")
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
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        return {f.name: plain(getattr(value, f.name)) for f in dataclasses.fields(value)}
    if isinstance(value, enum.Enum):
        return plain(value.value)
    if isinstance(value, Mapping):
        return {str(plain(k)): plain(v) for k, v in value.items()}
    if isinstance(value, (list, tuple)):
        return [plain(v) for v in value]
    if isinstance(value, np.ndarray):
        return plain(value.tolist())
    if isinstance(value, np.generic):
        return plain(value.item())
    if isinstance(value, float) and not math.isfinite(value):
        return None
    if isinstance(value, Path):
        return str(value)
    return value


def write_json(path: Path, content: Any) -> None:
    """Write JSON with a stable layout."""
    write_bytes(path, (json.dumps(plain(content), indent=1, ensure_ascii=False, allow_nan=False) + "\n").encode())


def read_json(path: Path) -> Any:
    """Read a JSON file, or say which file is missing or broken."""
    try:
        return json.loads(path.read_text(encoding="utf-8"))
    except FileNotFoundError as error:
        raise DataError(f"Reading {path.name}: there is no file {path}; is this the folder that an earlier step wrote?") from error
    except (json.JSONDecodeError, UnicodeDecodeError) as error:
        raise DataError(f"Reading {path}: not valid JSON ({error}); write it again with the step that made it.") from error


def write_arrays(path: Path, arrays: Mapping[str, np.ndarray]) -> None:
    """Write arrays to an .npz whose bytes depend on the content alone."""
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w", zipfile.ZIP_STORED) as archive:
        for name, array in arrays.items():
            content = io.BytesIO()
            np.lib.format.write_array(content, np.ascontiguousarray(array), allow_pickle=False)
            archive.writestr(zipfile.ZipInfo(f"{name}.npy", date_time=(1980, 1, 1, 0, 0, 0)), content.getvalue())
    write_bytes(path, buffer.getvalue())


def read_arrays(path: Path) -> dict[str, np.ndarray]:
    """Read all arrays of an .npz; pickled objects are refused."""
    try:
        with np.load(path, allow_pickle=False) as archive:
            return {name: archive[name] for name in archive.files}
    except FileNotFoundError as error:
        raise DataError(f"Reading {path.name}: there is no file {path}; is this the folder that an earlier step wrote?") from error
    except (ValueError, zipfile.BadZipFile) as error:
        raise DataError(f"Reading {path}: not a valid archive of arrays ({error}); write it again with the step that made it.") from error


def save_artifact(folder: Path, kind: str, content: Mapping[str, Any], arrays: Mapping[str, np.ndarray] | None = None) -> None:
    """Write `<kind>.json` (with the schema version) and, where there are arrays, `arrays.npz`."""
    folder = Path(folder)
    if arrays is not None:
        write_arrays(folder / "arrays.npz", arrays)
    write_json(folder / f"{kind}.json", {"schema": SCHEMA, "kind": kind, **content})


def load_artifact(folder: Path, kind: str) -> tuple[dict[str, Any], dict[str, np.ndarray]]:
    """Read what `save_artifact` wrote and check kind and schema version."""
    folder = Path(folder)
    content = read_json(folder / f"{kind}.json")
    found = (content.get("schema"), content.get("kind")) if isinstance(content, dict) else None
    if found != (SCHEMA, kind):
        raise DataError(
            f"Loading {kind} from {folder}: schema and kind should be {(SCHEMA, kind)}, found {found}; write it again with this version of kros."
        )
    arrays = read_arrays(folder / "arrays.npz") if (folder / "arrays.npz").exists() else {}
    return content, arrays
