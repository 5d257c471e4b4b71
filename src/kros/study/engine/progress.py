"""Progress for people: bars on a terminal, plain lines elsewhere, nothing when only JSON is wanted."""

from __future__ import annotations

import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from typing import Any

from ...core.work import Progress


class Lines(Progress):
    """One line a finished stage, and one every ten seconds while a stage advances."""

    def __init__(self, every_s: float = 10.0) -> None:
        self._every_s, self._said = every_s, time.monotonic()
        self._stage, self._done, self._began = "", 0, 0.0
        self._total: int | None = None

    def start(self, stage: str, total: int | None) -> None:
        """Remember what runs."""
        self._stage, self._total, self._done, self._began = stage, total, 0, time.monotonic()

    def advance(self) -> None:
        """Count."""
        self._done += 1
        if time.monotonic() - self._said >= self._every_s:
            of = f" of {self._total}" if self._total else ""
            self._say(f"  {self._stage} ... {self._done}{of}, {time.monotonic() - self._began:.0f} s")

    def finish(self, stage: str, seconds: float, skipped: bool) -> None:
        """Write one line."""
        self._say(_finished(stage, seconds, skipped))

    def _say(self, line: str) -> None:
        self._said = time.monotonic()
        with suppress(OSError, ValueError):  # the reader may be gone
            sys.stderr.write(f"{line}\n")
            sys.stderr.flush()


class Bars(Progress):
    """A bar for what is running, a line for what is done."""

    def __init__(self, display: Any) -> None:
        self._display = display
        self._task: Any = None

    def start(self, stage: str, total: int | None) -> None:
        """Show a bar; it pulses while the number of steps is unknown."""
        self._clear()
        self._task = self._display.add_task(stage, total=total)

    def advance(self) -> None:
        """Move the bar."""
        self._display.advance(self._task)

    def finish(self, stage: str, seconds: float, skipped: bool) -> None:
        """Replace the bar by a line."""
        self._clear()
        self._display.console.print(_finished(stage, seconds, skipped), highlight=False)

    def _clear(self) -> None:
        if self._task is not None:
            self._display.remove_task(self._task)
            self._task = None


def _finished(stage: str, seconds: float, skipped: bool) -> str:
    return f"{stage:<12} {'unchanged' if skipped else f'{seconds:6.1f} s'}"


@contextmanager
def make_progress(quiet: bool) -> Iterator[Progress]:
    """Return the progress listener that fits where standard error goes."""
    if quiet:
        yield Progress()
    elif not sys.stderr.isatty():
        yield Lines()
    else:
        from rich.console import Console
        from rich.progress import BarColumn, MofNCompleteColumn, TextColumn, TimeElapsedColumn
        from rich.progress import Progress as Display

        columns = (TextColumn("{task.description:<20}"), BarColumn(), MofNCompleteColumn(), TimeElapsedColumn())
        with Display(*columns, console=Console(stderr=True), transient=True) as display:
            yield Bars(display)
