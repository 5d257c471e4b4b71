"""Phase of the disturbance in every unit."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

from ..content import Section
from ..names import minus
from ..run_folder import RunFolder


def section(run: RunFolder, metrics: Mapping[str, Any]) -> Section | None:
    """Return the calibration; None for a plant without a phase."""
    if not run.calibrated:
        return None
    calibration, spec = run.calibration, run.calibration.spec
    text = (
        f"The gearbox disturbance is modelled as sin({spec.ratio:g} · {spec.angle} + {spec.parameter}); the phase is fixed when a unit is assembled, so every "
        "unit has its own. It is found in closed form from constant-velocity segments, forward and reverse apart, and the half turn that this leaves open is "
        f"settled for the whole population at once. Mean lag of the loop: {minus(format(math.degrees(calibration.lag_rad), '.1f'))}°."
    )
    missing = [row["unit"] for row in metrics.get("units", []) if row["status"] == "not calibrated"]
    paragraphs = [text] + ([f"Not calibrated, and left out of what follows: {', '.join(missing)}."] if missing else [])
    return Section("calibration", "Phase calibration", paragraphs, figures=["phase"])
