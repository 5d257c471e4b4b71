"""How the run was made: times, versions, settings."""

from __future__ import annotations

import json
import platform
from collections.abc import Mapping
from importlib.metadata import PackageNotFoundError, version
from typing import Any

from ..content import Cell, Section, Table
from ..names import number
from ..run_folder import RunFolder

_PACKAGES = ("kros", "numpy", "scipy", "matplotlib")


def section(run: RunFolder, metrics: Mapping[str, Any]) -> Section:
    """Return timings, versions and the resolved study."""
    text = (
        "Every stage leaves its artifacts beside this page; metrics.json holds the numbers above for machines. The same "
        "recordings and study give the same results."
    )
    timing = metrics.get("timing_s", {})
    longest = max(timing.values(), default=0.0) or 1.0
    rows = [[stage, Cell(number(seconds), bar=seconds / longest)] for stage, seconds in timing.items()]
    caption = "Wall-clock time; a stage that was found done counts with the time it took."
    versions = [
        ["Python", platform.python_version()],
        *([name, found] for name in _PACKAGES if (found := _version(name)) is not None),
    ]
    tables = [
        *([Table(["stage", "seconds"], rows, caption)] if rows else []),
        Table(["package", "version"], versions, "Versions"),
    ]
    study = json.dumps(run.study, indent=1, ensure_ascii=False)
    return Section("making", "How this was made", [text], tables, folded=[("The study, every setting resolved", study)])


def _version(name: str) -> str | None:
    try:
        return version(name)
    except PackageNotFoundError:
        return None
