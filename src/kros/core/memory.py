"""Memory of a process that makes and drops large arrays all the time."""

from __future__ import annotations

import ctypes
import re
from contextlib import suppress
from pathlib import Path

from . import limits

_TRIM, _MMAP = -1, -3  # M_TRIM_THRESHOLD and M_MMAP_THRESHOLD of glibc
_KEPT, _OF_HEAP = 1 << 28, 1 << 25  # bytes; glibc takes no more than the second


def keep_freed_memory() -> None:
    """Let the C library keep what is freed for the next array, up to 256 MB.

    Elsewhere than in glibc nothing changes.
    """
    with suppress(AttributeError, TypeError, OSError):
        mallopt = ctypes.CDLL(None).mallopt
        mallopt(_TRIM, _KEPT)
        mallopt(_MMAP, _OF_HEAP)


def pass_on_shortage(error: BaseException, path: Path) -> None:
    """Raise a shortage of memory as such, unless a damaged file states a size far beyond what it holds."""
    if isinstance(error, MemoryError):
        wanted = [int(digits) for digits in re.findall(r"\d{1,30}", str(error))]
        if max(wanted, default=0) <= limits.RATIO_FROM_BYTES + limits.MAX_RATIO * path.stat().st_size:
            raise MemoryError(f"{str(error) or 'no details'}, while {path} was read") from error
