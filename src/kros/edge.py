"""The edge of the command line: whatever goes wrong below becomes one message on standard error and an exit code.

In the library exceptions stay exceptions. Here each class of them gets its words; what is not expected at all is a
defect of kros and says so, with the way to its traceback (``kros --debug``).
"""

from __future__ import annotations

import contextlib
import logging
import os
import re
import signal
import sys
import threading
from collections.abc import Iterator
from typing import Any, TextIO

import typer
from typer.core import TyperGroup

from .core.errors import ConfigError, DataError, DimensionError, KrosError, MissingDependencyError

FAILED, BAD_INPUT, NOT_MET, UNDECIDED, SIGNALLED = 1, 2, 3, 4, 128
_SIGNALS = [getattr(signal, name) for name in ("SIGTERM", "SIGHUP") if hasattr(signal, name)]
_USAGE = [kind for kind in typer.BadParameter.__mro__ if kind.__name__ == "ClickException"]  # perhaps typer's own
_PASSED: tuple[type[BaseException], ...] = (typer.Exit, typer.Abort, *_USAGE)
_BAD_INPUT = (ConfigError, DataError, DimensionError, MissingDependencyError)


class EdgeGroup(TyperGroup):
    """Commands whose errors end as messages."""

    def invoke(self, ctx: Any) -> Any:
        """Run a command."""
        with contextlib.nullcontext() if ctx.params.get("debug") else edge(ctx):
            return super().invoke(ctx)


@contextlib.contextmanager
def edge(ctx: Any = None) -> Iterator[None]:
    """Turn any exception into one message on standard error and an exit code; `ctx` knows which command it is."""
    try:
        with _stoppable():
            yield
    except KeyboardInterrupt as stopped:
        number = signal.Signals(stopped.args[0] if stopped.args else signal.SIGINT)
        resumes = ctx is None or ctx.invoked_subcommand in (None, "run", "demo")
        again = "nothing half done is left; run the same command again."
        again = "the same command goes on where this one ended." if resumes else again
        typer.echo(f"kros: stopped by {number.name if stopped.args else 'Ctrl-C'}; {again}", err=True)
        raise typer.Exit(SIGNALLED + number) from stopped
    except _PASSED:
        raise
    except BrokenPipeError:
        _silence()
        raise typer.Exit(FAILED) from None
    except Exception as error:
        _silence_if_broken()
        typer.echo(f"kros: {message(error)}".encode(errors="backslashreplace").decode(), err=True)
        raise typer.Exit(BAD_INPUT if isinstance(error, _BAD_INPUT) else FAILED) from error


@contextlib.contextmanager
def _stoppable() -> Iterator[None]:
    """Raise KeyboardInterrupt with its number at a signal to stop, so that what is half done goes as after an error."""
    main = threading.current_thread() is threading.main_thread()
    signals = [number for number in _SIGNALS if main and signal.getsignal(number) is signal.SIG_DFL]

    def restore() -> None:
        for number in signals:
            signal.signal(number, signal.SIG_DFL)

    def stop(number: int, frame: object) -> None:
        restore()  # a second signal ends the process
        raise KeyboardInterrupt(number)

    for number in signals:
        signal.signal(number, stop)
    try:
        yield
    finally:
        restore()


class OnceHandler(logging.StreamHandler[TextIO]):
    """Writes every message in one line, and once."""

    def __init__(self) -> None:
        super().__init__(sys.stderr)
        self._written: set[str] = set()

    def format(self, record: logging.LogRecord) -> str:
        """Return one line."""
        text = record.getMessage()
        if record.name == "py.warnings":  # file, line, category and the line of source are of no use here
            text = re.sub(r"^.*?:\d+: (?:\w+: )?", "", text.strip().partition("\n")[0])
        return f"{record.levelname.lower()}: {' '.join(text.split())}"

    def emit(self, record: logging.LogRecord) -> None:
        """Write a record that was not written before."""
        line = self.format(record)
        if record.levelno < logging.WARNING or line not in self._written:
            self._written.add(line)
            super().emit(record)


def log_to_stderr(verbose: bool) -> None:
    """Send log and warnings to standard error, a line each; warnings and errors alone unless `verbose`."""
    if logging.getLogger().handlers:
        return  # the log is read elsewhere
    handler = OnceHandler()
    handler.addFilter(lambda record: verbose or record.name != "kros.data.survey")  # alerts stand behind the run
    logging.basicConfig(level=logging.INFO if verbose else logging.WARNING, handlers=[handler])
    logging.captureWarnings(True)


def message(error: Exception) -> str:
    """Return what the command line says about an exception."""
    if isinstance(error, KrosError):
        return str(error)
    if isinstance(error, MemoryError):
        reason = str(error) or "no details"
        return f"Memory: there is not enough of it ({reason}); use fewer --workers, shorter episodes or fewer units."
    if isinstance(error, OSError):
        names = [
            repr(os.fspath(n)) for n in (error.filename, error.filename2) if isinstance(n, str | bytes | os.PathLike)
        ]
        place = f": {' -> '.join(names)}" if names else ""
        return f"Files: {error.strerror or error}{place}; check the path, its permissions and the space that is left."
    return (
        f"Internal error, a defect of kros: {type(error).__name__}: {error}; run the command again as kros --debug ... "
        "for its traceback, and report it."
    )


def _silence_if_broken() -> None:
    """Write nothing more on standard output that is broken: Python would fail once more when it ends."""
    try:
        sys.stdout.flush()
    except (OSError, ValueError):
        _silence()


def _silence() -> None:
    with contextlib.suppress(OSError, ValueError):
        nowhere = os.open(os.devnull, os.O_WRONLY)
        os.dup2(nowhere, sys.stdout.fileno())
        os.close(nowhere)
