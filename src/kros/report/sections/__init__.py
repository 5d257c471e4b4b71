"""Sections of the report, one file a section, in the order of the paper's argument."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

from ..content import Section
from ..run_folder import RunFolder
from . import calibration, making, models, observers, other_conditions, outliers, recordings, relift, synthesis, uncertainty

Metrics = Mapping[str, Any]

SECTIONS: tuple[Callable[[RunFolder, Metrics], Section | None], ...] = (
    observers.result,
    recordings.section,
    calibration.section,
    models.section,
    uncertainty.section,
    synthesis.section,
    relift.section,
    observers.section,
    other_conditions.section,
    outliers.section,
    making.section,
)

__all__ = ["SECTIONS"]
