"""How the run was made: times, versions, settings."""

from __future__ import annotations

import json
import platform
from collections.abc import Mapping
from importlib.metadata import PackageNotFoundError, version
from typing import Any

from ..content import Cell, Section, Table, text_cells
from ..names import number
from ..run_folder import RunFolder

_PACKAGES = ("kros", "numpy", "scipy", "cvxpy", "clarabel", "matplotlib")


def section(run: RunFolder, metrics: Mapping[str, Any]) -> Section:
    """Return timings, versions and the resolved study."""
    study = json.dumps(run.study, indent=1, ensure_ascii=False)
    tables = [t for t in [_timing(metrics.get("timing_s", {})), _versions()] if t]
    text = (
        "Every stage leaves its artifacts beside this page; metrics.json holds the numbers above for machines. The same "
        "recordings and study give the same results."
    )
    return Section("making", "How this was made", [text], tables, [], [("The study, every setting resolved", study)])


def _timing(timing: Mapping[str, float]) -> Table | None:
    if not timing:
        return None
    longest = max(timing.values()) or 1.0
    rows = [[Cell(stage), Cell(number(seconds), bar=seconds / longest)] for stage, seconds in timing.items()]
    return Table(["stage", "seconds"], rows, "Wall-clock time; a stage that was found done counts with the time it took.")


def _versions() -> Table:
    rows = [text_cells("Python", platform.python_version())]
    rows += [text_cells(name, found) for name in _PACKAGES if (found := _version(name)) is not None]
    return Table(["package", "version"], rows, "Versions")


def _version(name: str) -> str | None:
    try:
        return version(name)
    except PackageNotFoundError:
        return None
