"""Sections of the report, one file a section, first what was found, then where it comes from."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

from ..content import Section
from ..run_folder import RunFolder
from . import (
    calibration,
    left_out,
    making,
    models,
    observers,
    other_conditions,
    outliers,
    recordings,
    relift,
    robustness,
    synthesis,
    uncertainty,
)

Metrics = Mapping[str, Any]

SECTIONS: tuple[Callable[[RunFolder, Metrics], Section | None], ...] = (
    observers.result,
    outliers.section,
    recordings.section,
    calibration.section,
    models.section,
    uncertainty.section,
    synthesis.section,
    relift.section,
    observers.section,
    left_out.section,
    robustness.section,
    other_conditions.section,
    making.section,
)

__all__ = ["SECTIONS"]
