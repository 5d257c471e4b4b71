"""C at run time: finding a compiler, and shared libraries that are compiled once on a machine."""

from __future__ import annotations

import ctypes
import hashlib
import logging
import os
import shutil
import stat
import subprocess
import tempfile
from collections.abc import Iterator
from pathlib import Path

_log = logging.getLogger(__name__)
COMPILERS = ("cc", "gcc", "clang")
_SECONDS = 120.0


def find_compiler() -> str | None:
    """Return a C compiler on the PATH; None where there is none."""
    return next((path for name in COMPILERS if (path := shutil.which(name))), None)


def load(source: str, flags: tuple[str, ...]) -> ctypes.CDLL | None:
    """Return a C source as a library, compiled once for this user on this machine; None where that cannot be, with one log entry."""
    compiler = find_compiler()
    if compiler is None:
        _log.info("Time loops run in NumPy, several times slower: no C compiler is on the PATH, tried %s.", ", ".join(COMPILERS))
        return None
    reason = "no folder for it can be written"
    for folder in _folders():
        try:
            library = folder / f"{_digest(source, flags, compiler)}.so"
            if not library.exists():
                _compile(source, flags, compiler, library)
            return ctypes.CDLL(str(library))
        except subprocess.CalledProcessError as error:
            reason = f"{compiler} refused the source: {error.stderr.strip()[:300]}"
            break
        except (OSError, subprocess.TimeoutExpired) as error:
            reason = str(error)  # such as a folder from which nothing may be executed
    _log.info("Time loops run in NumPy, several times slower: %s.", reason)
    return None


def _digest(source: str, flags: tuple[str, ...], compiler: str) -> str:
    """What a library depends on; code for one processor need not run on another that sees the same home."""
    found = os.stat(compiler)
    processor = Path("/proc/cpuinfo")
    flags_of = [line for line in processor.read_text().splitlines() if line.startswith(("flags", "Features"))] if processor.exists() else []
    parts = (source, *flags, os.path.realpath(compiler), f"{found.st_size} {found.st_mtime_ns}", *os.uname()[::4], *flags_of[:1])
    return hashlib.sha256("\0".join(parts).encode()).hexdigest()[:32]


def _folders() -> Iterator[Path]:
    """Folders to compile into that belong to this user alone: nobody else may put a library there."""
    cache = os.environ.get("XDG_CACHE_HOME")
    home = Path(cache) if cache else Path.home() / ".cache"
    for folder in (home / "kros", Path(tempfile.gettempdir()) / f"kros-{os.getuid()}"):
        try:
            folder.mkdir(mode=0o700, parents=True, exist_ok=True)
            found = folder.lstat()
        except (OSError, RuntimeError):
            continue
        if stat.S_ISDIR(found.st_mode) and found.st_uid == os.getuid() and not found.st_mode & 0o022 and os.access(folder, os.W_OK):
            yield folder


def _compile(source: str, flags: tuple[str, ...], compiler: str, library: Path) -> None:
    with tempfile.TemporaryDirectory(dir=library.parent) as scratch:
        made = Path(scratch) / library.name
        command = [compiler, *flags, "-x", "c", "-", "-o", str(made), "-lm"]
        subprocess.run(command, input=source, capture_output=True, text=True, check=True, timeout=_SECONDS)
        os.replace(made, library)
