"""A folder that one process works in: a lock that ends with its process, however that ends.

The operating system holds the lock, not the file: one that a killed process left blocks nobody.
"""

from __future__ import annotations

import errno
import logging
import os
import socket
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from datetime import datetime
from pathlib import Path

from .errors import ConfigError

log = logging.getLogger(__name__)

NAME = ".kros.lock"
_BUSY = {errno.EACCES, errno.EAGAIN, errno.EDEADLK}
_READ_ONLY = {errno.EACCES, errno.EPERM, errno.EROFS}

if sys.platform == "win32":
    import msvcrt

    def _take(handle: int, shared: bool) -> None:
        """Lock one byte far behind the text, which others may read."""
        os.lseek(handle, 1 << 20, os.SEEK_SET)
        msvcrt.locking(handle, msvcrt.LK_NBLCK, 1)

else:
    import fcntl

    def _take(handle: int, shared: bool) -> None:
        """Lock the file for all readers together, or for one writer."""
        fcntl.flock(handle, (fcntl.LOCK_SH if shared else fcntl.LOCK_EX) | fcntl.LOCK_NB)


@contextmanager
def locked(folder: Path, shared: bool = False) -> Iterator[None]:
    """Hold a folder: for writing alone, or for reading together with other readers."""
    handle = _open(folder, shared)
    try:
        if handle is not None and not shared:
            os.ftruncate(handle, 0)
            os.lseek(handle, 0, os.SEEK_SET)
            os.write(handle, _holder().encode())
        yield
    finally:
        if handle is not None:
            _release(folder / NAME, handle)


def _open(folder: Path, shared: bool) -> int | None:
    """Open and lock the file of a folder, again where its last holder has just removed it."""
    path = folder / NAME
    while True:
        try:
            handle = os.open(path, os.O_RDWR | os.O_CREAT | getattr(os, "O_NOFOLLOW", 0), 0o644)
        except OSError as error:
            if shared and error.errno in _READ_ONLY:
                return None
            raise
        try:
            _take(handle, shared)
        except OSError as error:
            if error.errno in _BUSY:
                told = os.read(handle, 200).decode(errors="replace") or "another process"
                os.close(handle)
                raise ConfigError(
                    f"Folder {folder}: {told} is at work in it; wait until it ends, or name another folder."
                ) from error
            log.warning(
                "folder %s: its file system has no locks (%s); do not run two studies in it at once", folder, error
            )
            return handle
        if _is_at(path, handle):
            return handle
        os.close(handle)


def _is_at(path: Path, handle: int) -> bool:
    try:
        return os.path.samestat(os.fstat(handle), path.lstat())
    except FileNotFoundError:
        return False


def _release(path: Path, handle: int) -> None:
    """Remove the file where nobody else reads, and let go."""
    try:
        _take(handle, shared=False)
        if _is_at(path, handle):
            path.unlink()
    except OSError:
        pass  # other readers hold it, or the system keeps open files: the last one, or nobody, removes it
    finally:
        os.close(handle)


def _holder() -> str:
    return f"process {os.getpid()} on {socket.gethostname()}, since {datetime.now().astimezone().isoformat(timespec='seconds')},"
