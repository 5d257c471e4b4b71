"""Errors of all observers at a glance: a dot a unit's role, a row an observer.

Needs: the evaluation.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from math import ceil, floor, log10
from typing import TYPE_CHECKING

import numpy as np

from ..canvas import grid
from ..error_table import ErrorCell, error_table
from ..names import condition_label, observer_label, observer_look
from ..run_folder import NotShownError, RunFolder
from ..theme import Tone
from .drawing import Drawing
from .trajectories import states

if TYPE_CHECKING:
    from matplotlib.axes import Axes

NAME, TITLE = "errors", "Errors of all observers"


def draw(run: RunFolder) -> Drawing:
    """Draw one panel a channel; lines go from the mean to the worst off-nominal unit."""
    tables = {t.condition: t for t in error_table(run.evaluation["rows"], run.identify_on)}
    table = tables.get(run.identify_on)
    if table is None:
        raise NotShownError("no observer was run on held-out episodes")
    hidden = [c.name for c in states(run) if not c.measured] or table.channels
    order = sorted(table.observers, key=lambda o: -_order(table.cells[o], hidden))
    figure, axes = grid(1, len(table.channels), 0.36 * len(order) + 0.75, legend_rows=0, sharey=True)
    for panel, channel in zip(axes[0], table.channels, strict=True):
        for place, observer in enumerate(order):
            _draw_row(panel, place, table.cells[observer].get(channel), observer)
        panel.set_xscale("log")
        _keep_comparable(panel, [table.cells[o].get(channel) for o in order])
        panel.set_title(channel.replace("_", " "))
        panel.set_xlabel("error (% of range)")
        panel.grid(visible=False, axis="y")
    axes[0, 0].set_yticks(range(len(order)), [observer_label(o) for o in order])
    for label, observer in zip(axes[0, 0].get_yticklabels(), order, strict=True):
        label.set_fontweight("bold" if observer == run.deployed else "normal")
    axes[0, 0].set_ylim(-0.6, len(order) - 0.4)
    return Drawing(
        figure,
        f"RMS error in percent of the signal's range, {condition_label(run.identify_on)}, held-out episodes. Disc: mean over "
        "off-nominal units; bar: worst of them; "
        "ring: nominal unit. Logarithmic axes; best on top by the channels that are not measured; the observer that is handed over in bold.",
    )


def _order(cells: Mapping[str, ErrorCell], channels: Sequence[str]) -> float:
    """Mean logarithm of the errors in channels that are not measured; infinite where one diverged."""
    found = [cells[c].mean for c in channels if c in cells]
    means = [m for m in found if m is not None and m > 0]
    return float(np.mean(np.log(means))) if means and len(means) == len(found) else np.inf


def _draw_row(axes: Axes, place: int, cell: ErrorCell | None, observer: str) -> None:
    colour = observer_look(observer).colour
    if cell is None:  # not what this observer estimates
        return
    if cell.mean is None:
        axes.annotate("diverged", (0.98, place), xycoords=("axes fraction", "data"), ha="right", va="center", size=7, color=Tone.SOFT.light)
        return
    if cell.worst is not None:
        axes.plot([cell.mean, cell.worst], [place, place], color=colour, lw=1.6)
        axes.plot(cell.worst, place, "|", ms=8, mew=1.8, color=colour)
    axes.plot(cell.mean, place, "o", ms=5.5, color=colour)
    if cell.nominal is not None:
        axes.plot(cell.nominal, place, "o", ms=6, mfc="none", mec=colour, mew=1.0)


def _keep_comparable(axes: Axes, cells: Sequence[ErrorCell | None]) -> None:
    """Cut values ten thousand times the smallest: they differ from the rest in kind."""
    values = [v for c in cells if c is not None for v in (c.mean, c.worst, c.nominal) if v is not None and v > 0]
    if values:
        plain_log_ticks(axes, [v for v in values if v <= 1e4 * min(values)])


def plain_log_ticks(axes: Axes, values: Sequence[float], most: int = 3) -> None:
    """Fit a logarithmic axis around values and number it in plain figures, as many as there is room for."""
    from matplotlib.ticker import FixedLocator, NullLocator

    low, high = min(values) / 1.6, max(max(values) * 1.6, 4 * min(values))
    axes.set_xlim(low, high)
    axes.xaxis.set_major_locator(FixedLocator(log_ticks(low, high, most)))
    axes.xaxis.set_major_formatter("{x:g}")
    axes.xaxis.set_minor_locator(NullLocator())


def log_ticks(low: float, high: float, most: int = 3) -> list[float]:
    """Return at most `most` round numbers between two positive ones, in the densest steps that allows it."""
    exponents = range(floor(log10(low)), ceil(log10(high)) + 1)
    for steps in ((1, 2, 5), (1, 3), (1,)):
        found = [s * 10.0**e for e in exponents for s in steps if low <= s * 10.0**e <= high]
        if len(found) <= most:
            return found
    return found[:: ceil(len(found) / most)]
