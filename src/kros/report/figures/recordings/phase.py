"""Phase calibration of every unit: phase, lag, concentration (Appendix B)."""

from __future__ import annotations

import numpy as np

from ....data.population import OUTLIERS
from ....identify import PhaseCalibration
from ...canvas import Figure, grid, name_units, units_axis
from ...names import minus
from ...run_folder import RunFolder
from ...theme import Tone

GOOD = 0.8


def draw(run: RunFolder) -> tuple[Figure, str]:
    """Draw the calibration of a run."""
    calibration = run.calibration
    filed = [u for u, group in run.facts["groups"].items() if group == OUTLIERS]
    lags = np.degrees([c.lag_rad for u, c in calibration.units.items() if u not in filed])
    straddles = bool(np.any(np.abs(lags) < 90) and np.any(np.abs(lags) > 90))
    weak = [u for u, c in calibration.units.items() if c.concentration < GOOD]
    mean, low, high = (minus(f"{value:.0f}°") for value in (np.mean(lags), lags.min(), lags.max()))
    return phase_figure(calibration, filed), (
        "Phase of the gearbox disturbance against the angle, one point a unit: where each drive was assembled, so anything around the circle. "
        f"The loop's lag is common to the batch ({mean} in the mean, from {low} to {high})"
        + (
            "; it straddles 90°, where averaging over both directions would cancel, and each direction is averaged by itself. "
            if straddles
            else ". "
        )
        + (
            f"Concentration below {GOOD:g}: {', '.join(weak)}."
            if weak
            else f"Concentration is above {GOOD:g} for every unit: its segments agree."
        )
    )


def phase_figure(calibration: PhaseCalibration, filed: list[str] | None = None) -> Figure:
    """Draw phase, lag and concentration of every unit; units in `filed` take no part in pooled results and are drawn hollow."""
    units = list(calibration.units)
    values = [calibration.units[u] for u in units]
    figure, axes = grid(3, 1, 1.15, sharex=True)
    rows = (
        (np.degrees([v.phase_rad for v in values]), "phase (°)"),
        (np.degrees([v.lag_rad for v in values]), "lag (°)"),
        (np.array([v.concentration for v in values]), "concentration"),
    )
    places = np.arange(len(units))
    inside = np.array([u not in (filed or []) for u in units])
    for (row, label), panel in zip(rows, axes[:, 0], strict=True):
        for chosen, look in ((inside, {"ms": 4, "mec": "none"}), (~inside, {"ms": 5, "mfc": "none", "mew": 1.2})):
            (drawn,) = panel.plot(places[chosen], row[chosen], "o", color=Tone.BLUE.light, **look)
            name_units(drawn, [u for u, own in zip(units, chosen, strict=True) if own])
        panel.set_ylabel(label)
    axes[0, 0].set_ylim(-12, 372)
    axes[0, 0].set_yticks([0, 90, 180, 270, 360])
    axes[1, 0].axhline(np.degrees(calibration.lag_rad), color=Tone.SOFT.light, lw=0.8, ls="--")
    axes[2, 0].axhline(GOOD, color=Tone.SOFT.light, lw=0.8, ls="--")
    axes[2, 0].set_ylim(min(0.7, rows[2][0].min() - 0.02), 1.03)
    units_axis(axes[2, 0], units)
    return figure
