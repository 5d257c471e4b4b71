"""Stage: calibrate the phase of every unit and put the population on one branch."""

from __future__ import annotations

from ...identify import PhaseCalibration
from ...identify.calibration import calibrate
from ..engine.context import Context


def run(context: Context) -> None:
    """Calibrate, where the lifting has a phase."""
    if context.phase_spec is not None:
        found = calibrate(context.population, context.facts, context.phase_spec, context.work)
        found.save(context.store.draft("calibration"))


def load(context: Context) -> PhaseCalibration | None:
    """Return the calibration, where the lifting has a phase."""
    return PhaseCalibration.load(context.store.path("calibration")) if context.phase_spec is not None else None
