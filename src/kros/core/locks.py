"""A lock on a folder, which the system releases however the process ends; a file that is left locks nothing."""

from __future__ import annotations

import errno
import logging
import os
import socket
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from datetime import datetime
from pathlib import Path

from .errors import ConfigError

try:
    import fcntl
except ImportError:  # Windows, where a locked file cannot be read
    fcntl = None  # type: ignore[assignment]

log = logging.getLogger(__name__)

NAME = ".kros.lock"
_BUSY = {errno.EACCES, errno.EAGAIN, errno.EDEADLK}
_READ_ONLY = {errno.EACCES, errno.EPERM, errno.EROFS}


@contextmanager
def locked(folder: Path, shared: bool = False) -> Iterator[None]:
    """Hold a folder for writing alone, or for reading together with other readers, where it may be locked at all."""
    path = folder / NAME
    try:
        handle = _open(path, shared)
    except OSError as error:
        if not (shared and error.errno in _READ_ONLY):
            raise
        yield
        return
    try:
        if not shared:
            now = datetime.now().astimezone().isoformat(timespec="seconds")
            os.ftruncate(handle, 0)
            os.write(handle, f"process {os.getpid()} on {socket.gethostname()}, since {now},".encode())
        yield
    finally:
        with suppress(OSError):  # other readers hold it: the last one removes it
            _take(handle, shared=False)
            path.unlink()
        os.close(handle)


def _take(handle: int, shared: bool) -> None:
    """Lock a file for all readers together, or for one writer."""
    if fcntl is None:
        raise OSError(errno.ENOLCK, "none on Windows")
    fcntl.flock(handle, (fcntl.LOCK_SH if shared else fcntl.LOCK_EX) | fcntl.LOCK_NB)


def _open(path: Path, shared: bool) -> int:
    """Open and lock a file, again where its last holder has just removed it."""
    handle = os.open(path, os.O_RDWR | os.O_CREAT | getattr(os, "O_NOFOLLOW", 0), 0o644)
    try:
        _take(handle, shared)
        if os.path.samestat(os.fstat(handle), path.lstat()):
            return handle
    except FileNotFoundError:
        pass
    except OSError as error:
        if error.errno not in _BUSY:
            log.warning("%s: no file locks here (%s); do not run two studies in one folder at once", path, error)
            return handle
        holder = os.read(handle, 200).decode(errors="replace") or "another process"
        os.close(handle)
        advice = "wait until it ends, or name another folder"
        raise ConfigError(f"Folder {path.parent}: {holder} is using it; {advice}.") from error
    os.close(handle)
    return _open(path, shared)
