"""Files from outside: opened only when they are regular files, read up to a limit, parsed with one kind of error."""

from __future__ import annotations

import os
import re
import stat
import tomllib
from collections.abc import Iterable
from difflib import get_close_matches
from pathlib import Path
from typing import Any

from . import limits
from .errors import ConfigError, DataError, KrosError

_KINDS = {
    stat.S_IFDIR: "a folder",
    stat.S_IFIFO: "a named pipe",
    stat.S_IFSOCK: "a socket",
    stat.S_IFCHR: "a device",
    stat.S_IFBLK: "a device",
}
TEMPORARY = ".kros."
"""How names begin of what is beside its place until it is whole."""
_NAME = r"""(?:[\w-]+|"[^"\n]*"|'[^'\n]*')"""


def is_file(path: Path) -> bool:
    """Tell whether there is a regular file, not a link to one."""
    try:
        return stat.S_ISREG(path.lstat().st_mode)
    except (OSError, ValueError):
        return False


def require_regular(path: Path, limit: int, error: type[KrosError] = DataError) -> None:
    """Refuse what is not a regular file, or a larger one than is ever read."""
    try:
        status = path.stat()
    except FileNotFoundError as found:
        raise error(f"Reading {path}: there is no such file; check the path.") from found
    except (OSError, ValueError) as found:
        raise error(f"Reading {path}: {found}; check the path and the permissions.") from found
    if not stat.S_ISREG(status.st_mode):
        kind = _KINDS.get(stat.S_IFMT(status.st_mode), "not a regular file")
        raise error(f"Reading {path}: a regular file is needed, found {kind}; copy its content to a file first.")
    if status.st_size > limit:
        raise error(
            f"Reading {path}: files of up to {limit} bytes are read, found {status.st_size}; split it, or raise the "
            "limit in kros.core.limits."
        )


def read_bytes(path: Path, limit: int, error: type[KrosError] = DataError) -> bytes:
    """Return the content of a regular file of at most `limit` bytes."""
    require_regular(path, limit, error)
    try:
        with path.open("rb") as file:
            return file.read(
                min(limit, os.fstat(file.fileno()).st_size) + 1
            )  # Python makes room for as much as is asked for
    except OSError as found:
        raise error(f"Reading {path}: {found}; check the file and its permissions.") from found


def read_toml(path: Path, what: str) -> dict[str, Any]:
    """Read a TOML file."""
    content = read_bytes(path, limits.MAX_TOML_BYTES, ConfigError)
    try:
        return parse_toml(content.decode("utf-8-sig"))
    except (ValueError, RecursionError) as error:  # of decoding, of TOML, of numbers with thousands of digits
        raise ConfigError(f"{what} {path}: not a TOML file that can be used ({_said(error)}); correct it.") from error


def parse_toml(text: str) -> dict[str, Any]:
    """Parse TOML; tables deeper than `limits.MAX_TOML_DEPTH` are refused, since everything that walks them recurses."""
    dots = rf"(?<![\w-]){_NAME}(?:[ \t]*\.[ \t]*{_NAME}){{{limits.MAX_TOML_DEPTH}}}"
    if re.search(dots, text):  # before parsing, whose time grows with the square of their number
        raise ValueError(f"a key of more than {limits.MAX_TOML_DEPTH} names")
    tables = tomllib.loads(text)
    level: list[Any] = [tables]
    for _ in range(limits.MAX_TOML_DEPTH):
        level = [
            v
            for item in level
            for v in (item.values() if isinstance(item, dict) else item)
            if isinstance(v, (dict, list))
        ]
    if level:
        raise ValueError(f"tables or lists are nested more than {limits.MAX_TOML_DEPTH} deep")
    return tables


def _said(error: BaseException) -> str:
    return "nested too deeply" if isinstance(error, RecursionError) else shortened(str(error))


def shortened(text: str, longest: int = 300) -> str:
    """Return a text for a message, without the middle of a very long one."""
    return text if len(text) <= longest else f"{text[: longest // 2]} ... {text[-longest // 4 :]}"


def did_you_mean(name: object, known: Iterable[str]) -> str:
    """Return a hint for a message where a name is nearly one that is known, else nothing."""
    close = get_close_matches(str(name), list(known), n=1, cutoff=0.6)
    return f"; did you mean {close[0]!r}?" if close else ""
