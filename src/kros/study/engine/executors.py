"""Where maps over units run: here, in processes on this machine, or on a Dask cluster. The same code, the same bytes.

The order of the sums in a matrix product depends on the number of threads, so every worker uses one. Worker processes
hold one end of a pipe whose other end is this process's alone: they end when it is closed.
"""

import logging
import os
import socket
import sys
import time
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import CancelledError
from contextlib import contextmanager, suppress
from functools import partial
from threading import Lock
from typing import Any

from ...core import ConfigError, KrosError, Mapped, MissingDependencyError, Progress, frozen
from ...core.arrays import T
from ...core.linalg import pieces
from .store import code_key


class Lines(Progress):
    """One line a finished stage, and one every few seconds while a stage advances."""

    def __init__(self, every_s: float = 10.0) -> None:
        self._every_s, self._written = every_s, time.monotonic()
        self.start("", None)

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


log = logging.getLogger(__name__)
_BATCHES, _LARGEST = 1000, 1000  # of a map, and tasks in one of them: the scheduler spends a millisecond on a batch
_THREADS = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "ARROW_NUM_THREADS")
_ALONE = Lock()
_LOST = "the connection was lost; start scheduler and workers again: the same command goes on where this one ended."
_GIVEN_UP = (
    "one piece of work ended several workers, and was given up: memory ran out, or they were stopped. "
    "Give workers more memory, see their logs, and run the same command again: it goes on where this one ended."
)


@frozen
class DaskExecutor:
    """Maps on a Dask cluster, in batches where tasks are many."""

    client: Any
    address: str

    def __call__(self, function: Callable[[Any], T], tasks: Iterable[Any]) -> Iterator[T]:
        """Yield results in the order of the tasks, which run again elsewhere where a worker ends."""
        from distributed.client import ClosedClientError

        tasks = list(tasks)
        batches = [tasks[part] for part in pieces(len(tasks), min(_LARGEST, -(-len(tasks) // _BATCHES)))]
        try:
            futures = self.client.map(partial(run_batch, code_key(), function), batches, pure=False)
        except ClosedClientError as error:
            raise self._error(_LOST) from error
        return self._results(deque(futures))

    def _results(self, futures: deque[Any]) -> Iterator[Any]:
        """Yield results of batches; workers forget what was yielded."""
        from distributed import KilledWorker

        try:
            while futures:
                yield from futures.popleft().result()
        except KilledWorker as error:
            raise self._error(_GIVEN_UP) from error
        except CancelledError as error:
            raise self._error(_LOST) from error

    def _error(self, text: str) -> KrosError:
        return KrosError(f"Dask scheduler {self.address}: {text}")


def run_batch(key: str, function: Callable[[Any], T], tasks: Sequence[Any]) -> list[T]:
    """In a worker: run a batch of tasks, while no other one runs in this process."""
    from threadpoolctl import threadpool_limits

    worker = f"Dask worker on {socket.gethostname()}"
    if code_key() != key:
        raise KrosError(f"{worker}: its kros is not that of the study; install the same version on every worker.")
    with _ALONE, single_threaded(), threadpool_limits(1):
        try:
            return _each(function, tasks)
        except FileNotFoundError as error:
            need = "recordings and run folder must be in a shared folder, the same path on every worker"
            raise KrosError(f"{worker}: finds no {error.filename}; {need}.") from error


@contextmanager
def single_threaded() -> Iterator[None]:
    """Let processes that start now, and libraries for linear algebra that are loaded now, use one thread."""
    saved = {name: os.environ[name] for name in _THREADS if name in os.environ}
    os.environ.update(dict.fromkeys(_THREADS, "1"))
    try:
        yield
    finally:
        for name in _THREADS:
            os.environ.pop(name, None)
        os.environ.update(saved)


@contextmanager
def open_dask(address: str) -> Iterator[DaskExecutor]:
    """Connect to a Dask scheduler."""
    try:
        import threadpoolctl  # noqa: F401  # workers have what is installed here
        from distributed import Client
        from distributed.comm.addressing import get_address_host_port
    except ImportError as error:
        raise MissingDependencyError(f"--scheduler {address} needs Dask: pip install 'kros[dask]'.") from error
    try:
        get_address_host_port(address)  # a client made with something else goes on trying
        client = Client(address, set_as_default=False)
    except (OSError, ValueError) as error:
        problem = f"no Dask scheduler of this version answers there ({error})"
        raise ConfigError(f"--scheduler {address}: {problem}; correct the address.") from error
    if not client.nthreads():
        log.warning("Dask scheduler %s: has no workers yet; the study waits for them.", address)
    messages = logging.getLogger("distributed.client")
    level = messages.level
    messages.setLevel(logging.CRITICAL)  # a lost connection is an error here
    try:
        with client:
            yield DaskExecutor(client, address)
    finally:
        messages.setLevel(level)


_CHUNKS = 100  # of a map of many tasks, which are small: handing each out costs the parent a tenth of the work


def _in_processes(pool: Any, function: Callable[[Any], T], tasks: Iterable[Any]) -> Iterator[T]:
    """Map in worker processes, each with a single BLAS thread; work begins at once."""
    tasks = list(tasks)
    chunks = [tasks[part] for part in pieces(len(tasks), len(tasks) // _CHUNKS)]
    return _results(deque(pool.submit(_each, function, chunk) for chunk in chunks))


def _each(function: Callable[[Any], T], tasks: Sequence[Any]) -> list[T]:
    """In a worker: run a chunk of tasks."""
    return [function(task) for task in tasks]


def _results(futures: deque[Any]) -> Iterator[Any]:
    """Yield results of chunks; where a task fails, those that have not begun are not begun.

    Where the run itself is stopped, they end with the pool: Python 3.11 has a traceback for those that were cancelled.
    """
    from concurrent.futures.process import BrokenProcessPool

    try:
        while futures:
            yield from futures.popleft().result()
    except BrokenProcessPool as error:
        reason = 'memory ran out, or a script that asks for workers has no `if __name__ == "__main__":` in it'
        raise KrosError(f"A worker process ended: {reason}. Run again with fewer workers, or add that.") from error
    except Exception:
        for future in futures:
            future.cancel()
        raise


@contextmanager
def open_executor(workers: int = 1, scheduler: str | None = None) -> Iterator[Mapped]:
    """Open what maps over tasks: Dask for a scheduler's address, processes for more than one worker."""
    if workers < 1:
        raise ConfigError(f"--workers {workers}: at least 1 is needed.")
    if scheduler is not None:
        with open_dask(scheduler) as mapped:
            yield mapped
    elif workers == 1:
        yield map
    else:
        with single_threaded(), _pool(workers) as pool:
            yield partial(_in_processes, pool)


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
