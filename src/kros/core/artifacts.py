"""What is written and read: arrays in an .npz (no pickle), the rest in JSON, a schema version and a checksum of both.

Files appear whole or not at all, and are not read once changed. An edited JSON file without ``checksum`` is accepted.
"""

import hashlib
import io
import json
import math
import zipfile
from collections.abc import Callable, Iterator, Mapping
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import fields, is_dataclass
from functools import cache, wraps
from pathlib import Path
from types import GenericAlias
from typing import Any, ClassVar, Self

import numpy as np
from pydantic import ConfigDict, TypeAdapter
from pydantic_core import to_jsonable_python

from . import limits
from .arrays import ByName, Record, T
from .errors import DataError, KrosError
from .files import pass_on_shortage, read_bytes, shortened, write_bytes

SCHEMA = 1
CHECKSUM, _ARRAY = "checksum", "array in arrays.npz"
_AGAIN = "write it again with the step that made it"


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


def _digest(content: ByName) -> str:
    content = {key: value for key, value in content.items() if key != CHECKSUM}
    return "sha256:" + hashlib.sha256(json.dumps(content, sort_keys=True, separators=(",", ":")).encode()).hexdigest()


def with_checksum(content: ByName) -> Record:
    """Return the content, in JSON's own types, with its checksum as the last key."""
    whole: Record = plain(content)
    return {**whole, CHECKSUM: _digest(whole)}


def check_checksum(content: ByName, path: Path) -> bool:
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
    except Exception as error:  # what damaged archives raise has no common base
        pass_on_shortage(error, path)
        raise DataError(f"Reading {path}: not a valid archive ({error or type(error).__name__}); {_AGAIN}.") from error


def save_artifact(folder: Path, kind: str, content: ByName, arrays: Mapping[str, np.ndarray] | None = None) -> None:
    """Write `<kind>.json` (with schema version and checksum) and, where there are arrays, `arrays.npz`."""
    folder = Path(folder)
    whole = {"schema": SCHEMA, "kind": kind, **content}
    if arrays is not None:
        packed = pack_arrays(arrays)
        write_bytes(folder / "arrays.npz", packed)
        whole["arrays"] = hashlib.sha256(packed).hexdigest()
    write_json(folder / f"{kind}.json", with_checksum(whole))


def load_artifact(folder: Path, kind: str) -> tuple[Record, dict[str, np.ndarray]]:
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
    if digest is None:
        return content, {}
    packed = read_bytes(archive, limits.MAX_ARRAYS_BYTES)
    if hashlib.sha256(packed).hexdigest() != digest:
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


class Storable:
    """A dataclass that is written as an artefact: arrays by the names of fields, inner ones ``field/inner``."""

    KIND: ClassVar[str]

    def save(self, folder: Path) -> None:
        """Write it, with its arrays beside the rest."""
        content, arrays = divided(self)
        save_artifact(folder, self.KIND, content, arrays or None)

    @classmethod
    @loader
    def load(cls, folder: Path) -> Self:
        """Read what `save` wrote."""
        return united(cls, *load_artifact(folder, cls.KIND))


def divided(value: Any) -> tuple[Any, dict[str, np.ndarray]]:
    """Return a value in JSON's types, numbers that JSON has not as texts, and its arrays by where they are in it."""
    arrays = {}

    def plain_of(part: Any, name: str) -> Any:
        if isinstance(part, np.ndarray):
            arrays[name] = part
            return {_ARRAY: name}
        if is_dataclass(part):
            part = {f.name: getattr(part, f.name) for f in fields(part)}
        if isinstance(part, Mapping):
            return {str(k): plain_of(v, f"{name}/{k}".lstrip("/")) for k, v in part.items()}
        if isinstance(part, tuple | list):
            return [plain_of(v, f"{name}/{k}".lstrip("/")) for k, v in enumerate(part)]
        return str(part) if isinstance(part, float) and not math.isfinite(part) else part

    return plain_of(value, ""), arrays


def united(kind: Any, content: Any, arrays: Mapping[str, np.ndarray]) -> Any:
    """Return the value of a type that `divided` divided."""

    def whole(part: Any) -> Any:
        if isinstance(part, list):
            return [whole(v) for v in part]
        if not isinstance(part, dict):
            return part
        return arrays[part[_ARRAY]] if _ARRAY in part else {k: whole(v) for k, v in part.items()}

    return _adapter(kind).validate_python([whole(content)])[0]


@cache
def _adapter(kind: Any) -> TypeAdapter[Any]:
    """Return what checks one value of a type, built in a thread: an interrupt would be lost or changed inside it."""
    one: Any = GenericAlias(tuple, (kind,))
    with ThreadPoolExecutor(1) as pool:
        return pool.submit(TypeAdapter[Any], one, config=ConfigDict(arbitrary_types_allowed=True)).result()


def digest_of(*content: object) -> str:
    """Return a digest of plain content, dataclasses among it by their `repr`."""
    return hashlib.sha256(repr(content).encode()).hexdigest()


def file_digest(path: Path) -> str:
    """Return the SHA-256 of a file."""
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()
