"""Maps over units on a Dask cluster: the same code, one task at a time in a worker, one thread for linear algebra.

The order of the sums in a matrix product depends on the number of threads, so results have the same bytes only where
all workers use the same number. Libraries read the environment when they are loaded: threads are set in the running
process, around every task.
"""

from __future__ import annotations

import logging
import os
import socket
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import CancelledError
from contextlib import contextmanager
from functools import partial
from threading import Lock
from typing import Any, TypeVar

from ...core.errors import ConfigError, KrosError, MissingDependencyError
from ...core.work import Executor
from .store import code_key

T = TypeVar("T")
log = logging.getLogger(__name__)
_BATCHES, _LARGEST = 1024, 1000  # of a map, and tasks in one of them: the scheduler spends a millisecond on a batch
_THREADS = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "ARROW_NUM_THREADS")
_ALONE = Lock()
_LOST = "the connection was lost; start scheduler and workers again: the same command goes on where this one ended."
_GIVEN_UP = (
    "one piece of work ended several workers, and was given up: memory ran out, or they were stopped. "
    "Give workers more memory, see their logs, and run the same command again: it goes on where this one ended."
)


class DaskExecutor(Executor):
    """Runs tasks on a Dask cluster, in batches where they are many."""

    def __init__(self, client: Any, address: str) -> None:
        self._client, self._address = client, address

    def map(self, function: Callable[[Any], T], tasks: Iterable[Any]) -> Iterator[T]:
        """Yield results in the order of the tasks, which run again elsewhere where a worker ends."""
        from distributed.client import ClosedClientError

        tasks = list(tasks)
        size = min(_LARGEST, -(-len(tasks) // _BATCHES)) or 1
        batches = [tasks[start : start + size] for start in range(0, len(tasks), size)]
        try:
            futures = self._client.map(partial(run_batch, code_key(), function), batches, pure=False)
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
        return KrosError(f"Dask scheduler {self._address}: {text}")


def run_batch(key: str, function: Callable[[Any], T], tasks: Sequence[Any]) -> list[T]:
    """In a worker: run a batch of tasks, while no other one runs in this process."""
    from threadpoolctl import threadpool_limits

    worker = f"Dask worker on {socket.gethostname()}"
    if code_key() != key:
        raise KrosError(f"{worker}: its kros is not that of the study; install the same version on every worker.")
    with _ALONE, single_threaded(), threadpool_limits(1):
        try:
            return [function(task) for task in tasks]
        except FileNotFoundError as error:
            needed = "recordings and run folder must be in a shared folder, the same path on every worker"
            raise KrosError(f"{worker}: finds no {error.filename}; {needed}.") from error


@contextmanager
def single_threaded() -> Iterator[None]:
    """Let processes that start now, and libraries for linear algebra that are loaded now, use one thread."""
    saved = {name: os.environ.get(name) for name in _THREADS}
    os.environ.update(dict.fromkeys(_THREADS, "1"))
    try:
        yield
    finally:
        for name, value in saved.items():
            os.environ.pop(name, None)
            os.environ.update({} if value is None else {name: value})


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
