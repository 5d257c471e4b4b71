"""Sections of the report, one file a section, first what was found, then where it comes from."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

from ..content import Section
from ..run_folder import RunFolder
from . import (
    calibration,
    deployment,
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
    trust,
    uncertainty,
    units,
)

Metrics = Mapping[str, Any]

Maker = Callable[[RunFolder, Metrics], Section | None]
SECTIONS: tuple[Maker, ...] = (deployment.section, observers.section, units.section, trust.section)
EVIDENCE: tuple[Maker, ...] = (
    recordings.section,
    calibration.section,
    models.section,
    uncertainty.section,
    synthesis.section,
    relift.section,
    outliers.section,
    observers.estimates,
    left_out.section,
    robustness.section,
    other_conditions.section,
    making.section,
)
