"""What observers do when measurements are worse than in the recordings."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from ..content import Section
from ..run_folder import RunFolder

_TEXT = (
    "Recordings are made with care; machines in the field lose samples, are badly calibrated, or have a cheaper sensor. Here the measurements of "
    "held-out episodes are disturbed in one way at a time, beyond the sensor that is declared, and the observers are not informed. "
    "Where errors double stands under Trust."
)


def section(run: RunFolder, metrics: Mapping[str, Any]) -> Section | None:
    """Return the curves; None where the study ran nothing of it."""
    return Section("robustness", "Robustness", [_TEXT], [], ["robustness"]) if metrics.get("robustness") else None
