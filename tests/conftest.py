"""Settings shared by all tests."""

from __future__ import annotations

import os
from pathlib import Path

import pytest
from hypothesis import HealthCheck, settings

# Properties are drawn from a fixed seed and without a time limit, so that a test's outcome depends on the code alone.
settings.register_profile("kros", derandomize=True, deadline=None, suppress_health_check=[HealthCheck.too_slow])
settings.load_profile("kros")


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
