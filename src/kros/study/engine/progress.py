"""Progress for people: a line a stage on standard error."""

from __future__ import annotations

import sys
import time
from contextlib import suppress

from ...core.work import Progress


class Lines(Progress):
    """One line a finished stage, and one every few seconds while a stage advances."""

    def __init__(self, every_s: float = 10.0) -> None:
        self._every_s, self._written = every_s, time.monotonic()
        self._stage, self._done, self._began = "", 0, 0.0
        self._total: int | None = None

    def start(self, stage: str, total: int | None) -> None:
        """Remember what runs."""
        self._stage, self._total, self._done, self._began = stage, total, 0, time.monotonic()

    def advance(self) -> None:
        """Count."""
        self._done += 1
        if time.monotonic() - self._written >= self._every_s:
            of = f" of {self._total}" if self._total else ""
            self._write(f"  {self._stage} ... {self._done}{of}, {time.monotonic() - self._began:.0f} s")

    def finish(self, stage: str, seconds: float, skipped: bool) -> None:
        """Write one line."""
        self._write(f"{stage:<12} {'unchanged' if skipped else f'{seconds:6.1f} s'}")

    def _write(self, line: str) -> None:
        self._written = time.monotonic()
        with suppress(OSError, ValueError):  # the reader may be gone
            sys.stderr.write(f"{line}\n")
            sys.stderr.flush()
