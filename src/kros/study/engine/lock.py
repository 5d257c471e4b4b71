"""Run folders are locked while they are used."""

import errno
import logging
import os
import socket
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from ...core import ConfigError

try:
    import fcntl
except ImportError:  # Windows, where a locked file cannot be read
    fcntl = None  # type: ignore[assignment]

log = logging.getLogger(__name__)
NAME = ".kros.lock"


@contextmanager
def locked(folder: Path, shared: bool = False) -> Iterator[None]:
    """Hold a folder for writing alone, or for reading together with other readers, where it may be locked at all."""
    path = folder / NAME
    try:
        handle = os.open(path, os.O_RDWR | os.O_CREAT | getattr(os, "O_NOFOLLOW", 0), 0o644)
    except OSError as error:
        if not shared or error.errno not in (errno.EACCES, errno.EPERM, errno.EROFS):
            raise
        yield
        return
    try:
        _take(handle, path, shared)
        if not shared:
            os.ftruncate(handle, 0)
            os.write(handle, f"process {os.getpid()} on {socket.gethostname()}".encode())
        try:
            yield
        finally:
            with suppress(OSError):  # other readers hold it: the last one removes it
                _lock(handle, shared=False)
                path.unlink()
    finally:
        os.close(handle)


def _lock(handle: int, shared: bool) -> None:
    """Lock a file for all readers together, or for one writer."""
    if fcntl is None:
        raise OSError(errno.ENOLCK, "none on Windows")
    fcntl.flock(handle, (fcntl.LOCK_SH if shared else fcntl.LOCK_EX) | fcntl.LOCK_NB)


def _take(handle: int, path: Path, shared: bool) -> None:
    """Lock a file, or refuse where another process holds it or has just removed it."""
    try:
        _lock(handle, shared)
        busy = not path.exists() or not os.path.samestat(os.fstat(handle), path.stat())
    except BlockingIOError:
        busy = True
    except OSError as error:
        log.warning("%s: no file locks here (%s); do not run two studies in one folder at once", path, error)
        busy = False
    if busy:
        holder = os.read(handle, 200).decode(errors="replace") or "another process"
        raise ConfigError(f"Folder {path.parent}: {holder} is using it; wait until it ends, or name another.")
