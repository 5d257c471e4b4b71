"""Settings shared by all tests."""

from __future__ import annotations

import gc
import os

os.environ["OMP_NUM_THREADS"] = "1"  # before NumPy: processes of several threads each would wait for one another

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import HealthCheck, settings

from kros.synthesis import GeneralizedPlant

# Properties are drawn from a fixed seed and without a time limit, so that a test's outcome depends on the code alone.
settings.register_profile("kros", derandomize=True, deadline=None, suppress_health_check=[HealthCheck.too_slow])
settings.load_profile("kros")

# What warns about numbers is an error in worker processes and commands that tests start too, not only in the process of pytest.
os.environ["PYTHONWARNINGS"] = "error::RuntimeWarning"

# Files that need the demo's study, which is made once for all of them, and what takes longest and begins first, that processes end together.
DEMO = {f"tests/e2e/test_{name}.py" for name in ("demo", "edge", "faults", "field", "motor_drives", "report")}
LONGEST = [
    "demo",
    *(
        f"tests/e2e/test_{name}.py"
        for name in ("examples", "short_way", "units_of_measure", "run_folder", "sampling_rates")
    ),
]


def group_of(nodeid: str) -> str:
    """Return what tests belong to that run in one process, one after the other: their file, or the demo."""
    path = nodeid.partition("::")[0]
    return "demo" if path in DEMO else path


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Put the longest first; refuse a file that would make the demo's study once more."""
    groups = {item.nodeid: group_of(item.nodeid) for item in items}
    if unknown := {
        item.path.name
        for item in items
        if {"demo", "paper"} & set(getattr(item, "fixturenames", ())) and groups[item.nodeid] != "demo"
    }:
        raise pytest.UsageError(
            f"tests/conftest.py, DEMO: should name {', '.join(sorted(unknown))}, which needs the demo's study."
        )
    items.sort(key=lambda item: LONGEST.index(groups[item.nodeid]) if groups[item.nodeid] in LONGEST else len(LONGEST))


def pytest_collection_finish() -> None:
    """Take what was imported and collected out of garbage collection, which would go through all of it many times."""
    gc.collect()
    gc.freeze()


@pytest.hookimpl(optionalhook=True)
def pytest_xdist_make_scheduler(config: pytest.Config, log: Any) -> Any:
    """Hand tests to processes by `group_of`, in their order: what pytest-xdist does by marks does nothing with pytest 9.2."""
    from xdist.scheduler import LoadScopeScheduling

    class Groups(LoadScopeScheduling):
        def _split_scope(self, nodeid: str) -> str:
            return group_of(nodeid)

    config.option.loadscopereorder = False
    return Groups(config, log)


@pytest.fixture(scope="session")
def recordings() -> Path:
    """Folder of real recordings, named by the environment variable KROS_DATA."""
    folder = os.environ.get("KROS_DATA")
    if not folder:
        pytest.skip("real recordings: the environment variable KROS_DATA names no folder")
    path = Path(folder)
    if not path.is_dir():
        pytest.fail(f"KROS_DATA = {folder} is no folder; unset it or name the folder of the recordings")
    return path


@pytest.fixture(scope="session")
def one_state() -> Callable[..., GeneralizedPlant]:
    """Build a regular generalized plant of one state, with some of its matrices changed."""
    parts: dict[str, Any] = {
        "A": [[0.9]],
        "B1": [[1.0, 0.0]],
        "B2": [[1.0]],
        "C1": [[1.0], [0.0]],
        "C2": [[1.0]],
        "D11": np.zeros((2, 2)),
        "D12": [[0.0], [1.0]],
        "D21": [[0.0, 1.0]],
        "D22": [[0.0]],
        "dt": 1.0,
    }
    return lambda **changes: GeneralizedPlant(**{**parts, **changes})
