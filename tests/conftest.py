"""Settings shared by all tests."""

from __future__ import annotations

import os
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


@pytest.hookimpl(tryfirst=True)  # before xdist reads the groups
def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Keep the tests of a file in one process, and all files that need the demo's study in one, so that it is made once."""
    needing = {item.path for item in items if "demo" in getattr(item, "fixturenames", ())}
    for item in items:
        item.add_marker(pytest.mark.xdist_group("demo" if item.path in needing else str(item.path)))


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
