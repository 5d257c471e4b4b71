"""Outlier scores of all units against the threshold, a row a condition.

Needs: outlier scores.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from ...data.population import natural_key
from ..canvas import grid
from ..names import condition_label
from ..run_folder import NotShownError, RunFolder
from ..theme import Tone
from .drawing import Drawing
from .units_axis import units_axis

if TYPE_CHECKING:
    from matplotlib.axes import Axes

NAME, TITLE = "outlier_scores", "Outlier scores"


def draw(run: RunFolder) -> Drawing:
    """Draw one point a unit, flagged ones filled."""
    rows = run.outlier_rows
    if not rows:
        raise NotShownError("outlier scores need at least three units in a condition")
    conditions = sorted({r["condition"] for r in rows}, key=natural_key)
    units = sorted({r["unit"] for r in rows}, key=natural_key)
    figure, axes = grid(len(conditions), 1, 1.6, legend_rows=0, sharex=True)
    for panel, condition in zip(axes[:, 0], conditions, strict=True):
        _panel(panel, [r for r in rows if r["condition"] == condition], units)
        panel.set_title(condition_label(condition))
        panel.set_ylabel("score (dB)")
    units_axis(axes[-1, 0], units)
    flagged = sorted({r["unit"] for r in rows if r["outlier"]}, key=natural_key)
    text = "How far every unit sticks out of the cover of all the others, in each condition. Dashed: threshold for the stated rate of false alarms. "
    return Drawing(figure, text + (f"Above it: {', '.join(flagged)}." if flagged else "No unit is above it."))


def _panel(axes: Axes, rows: list[dict[str, Any]], units: list[str]) -> None:
    places = {u: i for i, u in enumerate(units)}
    for row in rows:
        if row["score"] is None:
            continue
        tone = Tone.ALARM if row["outlier"] else Tone.BLUE
        axes.plot(places[row["unit"]], row["score"], "o", ms=6 if row["outlier"] else 4, color=tone.light)
        if row["outlier"]:
            axes.annotate(
                row["unit"],
                (places[row["unit"]], row["score"]),
                xytext=(6, 0),
                textcoords="offset points",
                va="center",
                size=7.5,
                color=tone.light,
            )
    threshold = next((r[key] for r in rows for key in ("threshold", "threshold_db") if r.get(key) is not None), None)
    if threshold is not None and np.isfinite(threshold):
        axes.axhline(threshold, color=Tone.SOFT.light, lw=0.9, ls="--")
        axes.annotate(
            "threshold",
            (1, threshold),
            xycoords=("axes fraction", "data"),
            xytext=(-2, 3),
            textcoords="offset points",
            ha="right",
            size=7.5,
        )
    axes.margins(y=0.15)
