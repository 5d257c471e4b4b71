"""C at run time: finding a compiler, and shared libraries that are compiled once on a machine."""

from __future__ import annotations

import contextlib
import ctypes
import hashlib
import logging
import os
import shutil
import signal
import stat
import subprocess
import sys
import tempfile
from collections.abc import Iterator, Sequence
from pathlib import Path

_log = logging.getLogger(__name__)
COMPILERS = ("cc", "gcc", "clang")
_SECONDS = 60.0  # after which a compiler, or a library that is tried, is given up
_TRIED = "\nint kros_trial(int);\nint kros_trial(int x) { return 2 * x; }\n"
_LOADED = "import ctypes, sys; library = ctypes.CDLL(sys.argv[1]); "
_TRIAL = _LOADED + "sys.exit(library.kros_trial(21) != 42)"


def find_compiler() -> str | None:
    """Return a C compiler on the PATH; None where there is none."""
    return next((path for name in COMPILERS if (path := shutil.which(name))), None)


def load(source: str, flags: tuple[str, ...]) -> ctypes.CDLL | None:
    """Return a C source as a library, compiled once on this machine; None where that cannot be."""
    compiler = find_compiler()
    if compiler is None:
        _log.info(
            "Time loops run in NumPy, several times slower: no C compiler is on the PATH, tried %s.",
            ", ".join(COMPILERS),
        )
        return None
    reason = "no folder for it can be written"
    for folder in _folders():
        try:
            library = folder / f"{_digest(source, flags, compiler)}.so"
            if not _is_whole(library):
                _build(source, flags, compiler, library)
            return ctypes.CDLL(str(library))
        except subprocess.SubprocessError as error:
            reason = str(error)
            break
        except OSError as error:
            reason = str(error)  # such as a folder from which nothing may be executed
    _log.info("Time loops run in NumPy, several times slower: %s.", reason)
    return None


def run_tool(command: Sequence[str], given: str = "", seconds: float = _SECONDS) -> str:
    """Run a tool in a process group that ends in time; return what it printed, or raise with the reason in a line."""
    with subprocess.Popen(
        command,
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        start_new_session=True,
        text=True,
        errors="replace",
    ) as running:
        try:
            printed, _ = running.communicate(given, timeout=seconds)
        except subprocess.TimeoutExpired as error:
            raise subprocess.SubprocessError(f"{command[0]} has not ended after {seconds:g} s") from error
        finally:  # what it has started itself would keep the pipe open
            with contextlib.suppress(ProcessLookupError):
                os.killpg(running.pid, signal.SIGKILL)
    if running.returncode:
        raise subprocess.SubprocessError(
            f"{command[0]} ended with {running.returncode}: {' '.join(printed.split())[:300]}"
        )
    return str(printed)


def _is_whole(library: Path) -> bool:
    """Tell whether a library has the bytes that were tried when it was compiled."""
    try:
        return library.with_suffix(".sha256").read_text() == hashlib.sha256(library.read_bytes()).hexdigest()
    except (OSError, ValueError):
        return False


def _digest(source: str, flags: tuple[str, ...], compiler: str) -> str:
    """What a library depends on; code for one processor need not run on another that sees the same home."""
    found = os.stat(compiler)
    processor = Path("/proc/cpuinfo")
    flags_of = (
        [line for line in processor.read_text().splitlines() if line.startswith(("flags", "Features"))]
        if processor.exists()
        else []
    )
    parts = (
        source,
        *flags,
        os.path.realpath(compiler),
        f"{found.st_size} {found.st_mtime_ns}",
        *os.uname()[::4],
        *flags_of[:1],
    )
    return hashlib.sha256("\0".join(parts).encode()).hexdigest()[:32]


def _folders() -> Iterator[Path]:
    """Folders to compile into that belong to this user alone: no other may put a library there."""
    folders = [Path(tempfile.gettempdir()) / f"kros-{os.getuid()}"]
    with contextlib.suppress(RuntimeError):  # a user without a home
        cache = os.environ.get("XDG_CACHE_HOME")
        folders.insert(0, (Path(cache) if cache else Path.home() / ".cache") / "kros")
    for folder in folders:
        try:
            folder.mkdir(mode=stat.S_IRWXU, parents=True, exist_ok=True)
            found = folder.lstat()
        except (OSError, RuntimeError):
            continue
        if (
            stat.S_ISDIR(found.st_mode)
            and found.st_uid == os.getuid()
            and not found.st_mode & (stat.S_IWGRP | stat.S_IWOTH)
            and os.access(folder, os.W_OK)
        ):
            yield folder


def compile_library(command: Sequence[str], library: Path, given: str = "", trial: str = _LOADED) -> None:
    """Compile a shared library and load it in a process of its own; errors as of `run_tool`."""
    run_tool([*command, "-o", str(library), "-lm"], given)
    try:
        run_tool([sys.executable, "-S", "-c", trial, str(library)])
    except subprocess.SubprocessError as error:
        raise subprocess.SubprocessError(f"what {command[0]} made does not run") from error


def _build(source: str, flags: tuple[str, ...], compiler: str, library: Path) -> None:
    """Compile a library, try it in a process of its own, and put it in place with its checksum."""
    with tempfile.TemporaryDirectory(dir=library.parent) as scratch:
        built, checksum = Path(scratch) / library.name, Path(scratch) / "sha256"
        compile_library([compiler, *flags, "-x", "c", "-"], built, source + _TRIED, _TRIAL)
        checksum.write_text(hashlib.sha256(built.read_bytes()).hexdigest())
        os.replace(built, library)
        os.replace(checksum, library.with_suffix(".sha256"))
