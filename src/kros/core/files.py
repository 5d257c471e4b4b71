"""Files: opened only when they are regular, read up to a limit, written whole."""

import os
import re
import shutil
import stat
import tempfile
import tomllib
from collections.abc import Iterable, Iterator
from contextlib import contextmanager, suppress
from difflib import get_close_matches
from pathlib import Path
from typing import Any

from . import limits
from .errors import ConfigError, DataError, KrosError

TEMPORARY = ".kros."  # how names begin of what is beside its place until it is whole


def is_file(path: Path) -> bool:
    """Tell whether there is a regular file, not a link to one."""
    return os.path.isfile(path) and not os.path.islink(path)


def stamp_of(path: Path) -> tuple[int, int]:
    """Return size and time of change of a file."""
    status = path.stat()
    return status.st_size, status.st_mtime_ns


def require_regular(path: Path, limit: int, error: type[KrosError] = DataError) -> None:
    """Refuse what is not a regular file, or a larger one than is ever read."""
    try:
        status = path.stat()
    except FileNotFoundError as missing:
        raise error(f"Reading {path.name}: there is no file {path}; check the path.") from missing
    except (OSError, ValueError) as failure:
        raise error(f"Reading {path}: {failure}; check the path and the permissions.") from failure
    if not stat.S_ISREG(status.st_mode):
        found = "a folder" if stat.S_ISDIR(status.st_mode) else "a pipe, socket or device"
        raise error(f"Reading {path}: a regular file is needed, found {found}; name a file.")
    if status.st_size > limit:
        raise error(f"Reading {path}: files of up to {limit} bytes are read, found {status.st_size}; split it.")


def read_bytes(path: Path, limit: int, error: type[KrosError] = DataError) -> bytes:
    """Return the content of a regular file of at most `limit` bytes."""
    require_regular(path, limit, error)
    try:
        return path.read_bytes()
    except OSError as failure:
        raise error(f"Reading {path}: {failure}; check the file and its permissions.") from failure


@contextmanager
def draft_beside(folder: Path) -> Iterator[Path]:
    """Give the path of a draft in a folder, to be moved to its place; what is not moved is removed."""
    folder.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(prefix=TEMPORARY, dir=folder, ignore_cleanup_errors=True) as temporary:
        os.chmod(temporary, 0o755)  # workers of a cluster may be other users
        yield Path(temporary, "draft")


def write_bytes(path: Path, content: bytes) -> None:
    """Write a file so that a reader sees the old content or the new, never half of it."""
    with draft_beside(path.parent) as draft:
        draft.write_bytes(content)
        draft.replace(path)


@contextmanager
def whole_folder(out: Path) -> Iterator[Path]:
    """Give a folder to fill, which is moved to `out` at the end, or removed when anything fails."""
    out = out.absolute()
    if out.exists() and not (out.is_dir() and not any(out.iterdir())):
        raise DataError(f"Writing {out}: it exists and is not empty; choose another name or remove it first.")
    with draft_beside(out.parent) as draft:
        draft.mkdir()
        yield draft
        with suppress(FileNotFoundError):
            out.rmdir()
        draft.replace(out)


def link_or_copy(source: Path, target: Path) -> None:
    """Put a file in a second place: the same file where the file system can, else a copy with its times."""
    target.unlink(missing_ok=True)
    try:
        os.link(source, target)
    except OSError:
        shutil.copy2(source, target)


def read_toml(path: Path, what: str) -> dict[str, Any]:
    """Read a TOML file."""
    content = read_bytes(path, limits.MAX_TOML_BYTES, ConfigError)
    try:
        return tomllib.loads(content.decode("utf-8-sig"))
    except (ValueError, RecursionError) as error:  # of decoding, of TOML, of numbers with thousands of digits
        reason = "nested too deeply" if isinstance(error, RecursionError) else shortened(str(error))
        raise ConfigError(f"{what} {path}: not a TOML file that can be used ({reason}); correct it.") from error


def pass_on_shortage(error: BaseException, path: Path) -> None:
    """Raise a shortage of memory as such, unless a damaged file states a size that no file has."""
    stated = max(map(int, re.findall(r"\d{1,30}", str(error))), default=0)
    if isinstance(error, MemoryError) and stated <= limits.MAX_ARRAYS_BYTES:
        raise MemoryError(f"{str(error) or 'no details'}, while {path} was read") from error


def shortened(text: str, longest: int = 300) -> str:
    """Return a text for a message, without the middle of a very long one."""
    return text if len(text) <= longest else f"{text[: longest // 2]} ... {text[-longest // 4 :]}"


def did_you_mean(name: object, known: Iterable[str]) -> str:
    """Return a hint for a message where a name is nearly one that is known, else the end of a clause."""
    close = get_close_matches(str(name), list(known), n=1, cutoff=0.6)
    return f"; did you mean {close[0]!r}?" if close else ";"
