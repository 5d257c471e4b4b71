"""Where maps over units run: here, in processes on this machine, or on a Dask cluster. The same code, the same bytes.

Worker processes hold one end of a pipe whose other end is this process's alone: they end when it is closed, however
this process ended.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from typing import Any, TypeVar

from ...core.errors import ConfigError, KrosError
from ...core.work import Executor
from .cluster import open_dask, single_threaded

T = TypeVar("T")
_CHUNKS = 128  # of a map of many tasks, which are small: handing each out costs the parent a tenth of the work


@dataclass(frozen=True)
class ProcessExecutor(Executor):
    """Runs tasks in worker processes, each with a single BLAS thread."""

    pool: Any

    def map(self, function: Callable[[Any], T], tasks: Iterable[Any]) -> Iterator[T]:
        """Yield results in the order of the tasks, whose work begins at once."""
        tasks = list(tasks)
        return _results(self.pool.map(function, tasks, chunksize=max(1, len(tasks) // _CHUNKS)))


def _results(results: Iterator[T]) -> Iterator[T]:
    from concurrent.futures.process import BrokenProcessPool

    try:
        yield from results
    except BrokenProcessPool as error:
        reason = 'memory ran out, or a script that asks for workers has no `if __name__ == "__main__":` in it'
        raise KrosError(f"A worker process ended: {reason}. Run again with fewer workers, or add that.") from error


@contextmanager
def open_executor(workers: int = 1, scheduler: str | None = None) -> Iterator[Executor]:
    """Open the executor that fits: Dask for a scheduler's address, processes for more than one worker."""
    if workers < 1:
        raise ConfigError(f"--workers {workers}: at least 1 is needed.")
    if scheduler is not None:
        with open_dask(scheduler) as executor:
            yield executor
    elif workers == 1:
        yield Executor()
    else:
        with single_threaded(), _pool(workers) as pool:
            yield ProcessExecutor(pool)


@contextmanager
def _pool(workers: int) -> Iterator[Any]:
    """Give a pool of processes; where it is left early, their work is not waited for."""
    import multiprocessing
    from concurrent.futures import ProcessPoolExecutor

    context = multiprocessing.get_context("spawn")
    theirs, ours = context.Pipe(duplex=False)
    pool = ProcessPoolExecutor(workers, mp_context=context, initializer=_begin, initargs=(theirs,))
    try:
        yield pool
        pool.shutdown()
    finally:
        ours.close()
        pool.shutdown(cancel_futures=True)
        theirs.close()


def _begin(pipe: Any) -> None:
    """In a worker: end when the other end of a pipe is closed; the parent handles interrupts from the keyboard."""
    import signal
    from threading import Thread

    def watch() -> None:
        with suppress(EOFError, OSError):
            pipe.recv_bytes()
        os._exit(1)

    signal.signal(signal.SIGINT, signal.SIG_IGN)
    Thread(target=watch, name="ends with its parent", daemon=True).start()


def available_cores() -> int:
    """Return the number of cores this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
