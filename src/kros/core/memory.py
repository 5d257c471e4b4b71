"""Memory of a process that makes and drops large arrays all the time."""

from __future__ import annotations

import ctypes
from contextlib import suppress

_TRIM, _MMAP = -1, -3  # M_TRIM_THRESHOLD and M_MMAP_THRESHOLD of glibc
_RETAINED, _OF_HEAP = 1 << 28, 1 << 25  # bytes; glibc takes no more than the second


def keep_freed_memory() -> None:
    """Let glibc keep what is freed for the next array, up to 256 MB; nothing changes elsewhere."""
    with suppress(AttributeError, TypeError, OSError):
        mallopt = ctypes.CDLL(None).mallopt
        mallopt(_TRIM, _RETAINED)
        mallopt(_MMAP, _OF_HEAP)
