"""Worker processes: the same results, and they end when their work is not wanted any more."""

from __future__ import annotations

import multiprocessing
import os
import time
from functools import partial

import numpy as np
import pytest

from kros.core.errors import KrosError
from kros.core.work import Work
from kros.study.engine.executors import open_executor


def square(x: int) -> int:
    return x * x


def refuse() -> None:
    raise KrosError("as it should")


def endless(_: int) -> None:
    time.sleep(1e6)


def overflow(size: float) -> float:
    return float(np.float64(size) * 1e300)


def die(_: int) -> None:
    os._exit(9)


@pytest.mark.parametrize("workers", [1, 2])
def test_results_come_in_order_and_warnings_about_numbers_are_errors(workers):
    with open_executor(workers) as executor:
        assert list(executor(square, range(5))) == [0, 1, 4, 9, 16]
        work = Work(executor)
        results, wrong = work.begin("first", (partial(square, x) for x in range(5))), work.begin("wrong", [refuse])
        assert work.run("meanwhile", [partial(square, 9)]) == [81]
        assert results() == [0, 1, 4, 9, 16]
        with pytest.raises(KrosError, match="as it should"):
            wrong()
        assert list(executor(overflow, [1.0])) == [1e300]
        with pytest.raises(RuntimeWarning, match="overflow"):
            list(executor(overflow, [1.0, 1e300]))


def test_work_that_is_abandoned_is_not_waited_for():
    with pytest.raises(RuntimeError, match="enough"), open_executor(2) as executor:  # noqa: PT012
        executor(endless, range(3))
        assert len(multiprocessing.active_children()) == 2
        raise RuntimeError("enough")
    assert not multiprocessing.active_children()


def test_a_worker_that_is_ended_from_outside_is_an_error_with_a_remedy():
    with pytest.raises(KrosError, match="fewer workers"), open_executor(2) as executor:
        list(executor(die, range(3)))
